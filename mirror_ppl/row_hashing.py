"""Hashing of rows to whole numbers, to find equal rows and share their work."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import torch
from torch import Tensor

EXACT = 32
"""Number of 48-bit keys whose sums are exact in 64-bit floats."""


@lru_cache(maxsize=1024)
def random_keys(number: int, device: torch.device, kind: int = 0) -> Tensor:
    """Random 62-bit keys ``[number]``: sums of different sets of them differ.

    The probability of equal sums is about 2**-62 if the keys' factors are small, as masks and
    indices are. Sums of sums need keys of two kinds; with one kind, rows and columns could be
    exchanged. Sorting numbers is a hundred times quicker than sorting rows.
    """
    keys = torch.randint(2**62, (number,), generator=torch.Generator().manual_seed(kind))
    return keys.to(device)


@lru_cache(maxsize=1024)
def exact_keys(number: int, device: torch.device) -> Tensor:
    """Random keys ``[number, G]`` for masks, which 64-bit floats multiply exactly and faster.

    Each of G groups of items has 48-bit keys, few enough that their sums are exact.
    """
    keys = (random_keys(number, device, kind=1) >> 14).double()
    group = torch.arange(number, device=device) // EXACT
    return torch.where(group[:, None] == group.unique(), keys[:, None], 0.0)


def row_numbers(rows: Tensor, kind: int = 0) -> Tensor:
    """Hash rows of whole numbers ``[..., N]`` to whole numbers ``[...]``, by ``random_keys``."""
    keys = random_keys(rows.shape[-1], rows.device, kind)
    # A GPU has no products of whole matrices; on the processor they take half the time of sums.
    return rows @ keys if rows.device.type == "cpu" else (rows * keys).sum(-1)


def distinct_rows(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the first of each set of equal rows of small whole numbers ``[M, N]``.

    Also returns the set of each row ``[M]``.
    """
    values, inverse = torch.unique(row_numbers(rows), return_inverse=True)
    first = torch.full((len(values),), len(rows), device=rows.device)
    first.scatter_reduce_(0, inverse, torch.arange(len(rows), device=rows.device), "amin")
    return first, inverse


def seed_of(values: Mapping[str, Tensor]) -> int:
    """Hash of numbers, to be used as a seed."""
    total = 0
    for value in values.values():
        whole = as_whole_numbers(value).flatten()
        total += int((whole * random_keys(len(whole), whole.device)).sum())
    return total % 2**62


def as_whole_numbers(values: Tensor) -> Tensor:
    """Convert numbers of any kind to whole ones of the same shape, equal for equal numbers."""
    if not values.is_floating_point():
        return values.long()
    if values.dtype == torch.double:
        wide = (values + 0.0).view(torch.int64)
        return wide + (wide >> 32)
    bits = (values.float() + 0.0).view(torch.int32).long()  # + 0.0: -0 is 0
    # As bits, small whole numbers end in zeros, and sums of multiples of a power of two would
    # collide more often. The sum increases with the bits, so that different numbers stay different.
    return bits + (bits >> 16)


def joint_rows(values: Mapping[str, Tensor], none: Tensor) -> Tensor:
    """Rows ``[M, N]`` of whole numbers, equal where all values ``[M, ...]`` are; or ``none``."""
    rows = [as_whole_numbers(value).reshape(len(value), -1) for value in values.values()]
    return torch.cat(rows, -1) if rows else none


def uniform_of(seed: int, *names: Tensor) -> Tensor:
    """Uniform numbers ``[...]`` in 0 to 1 that are a function of whole numbers ``[...]``.

    The same names have the same number, whatever else there is, and other names practically
    independent ones: Steele, Lea and Flood's mixing of bits (SplitMix64, 2014).
    """
    device = names[0].device
    bits = mixed(torch.tensor(seed, dtype=torch.long, device=device), *names)
    return ((bits >> 40) & (2**24 - 1)).to(torch.float32) / 2**24


def mixed(*names: Tensor) -> Tensor:
    """Whole numbers ``[...]`` that are a function of others; sums of them distinguish sets."""
    bits = _mixed(names[0].long())
    for name in names[1:]:
        bits = _mixed(bits + name.long())
    return bits


def _mixed(bits: Tensor) -> Tensor:
    bits = bits - 0x61C8864680B583EB  # that is + 0x9E3779B97F4A7C15, as a signed number
    for shift, factor in ((30, -0x40A7B892E31B1A47), (27, -0x6B2FB644ECCEEE15)):
        bits = (bits ^ ((bits >> shift) & (2 ** (64 - shift) - 1))) * factor
    return bits ^ ((bits >> 31) & (2**33 - 1))

"""Finding equal rows, which is where shared work comes from, and numbers that belong to rows."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


@lru_cache(maxsize=1024)
def random_keys(number: int, device: torch.device, kind: int = 0) -> Tensor:
    """Random 62-bit keys ``[number]``: sums of different sets of them differ.

    Sums of sums need keys of two kinds; with one kind, rows and columns could be exchanged.

    But for a chance of about one in 2**62, if what they are multiplied with is small, as masks
    and indices are. Sorting numbers is a hundred times quicker than sorting rows.
    """
    keys = torch.randint(2**62, (number,), generator=torch.Generator().manual_seed(kind))
    return keys.to(device)


def row_numbers(rows: Tensor, kind: int = 0) -> Tensor:
    """A whole number ``[...]`` for each row of whole numbers ``[..., N]``; see ``random_keys``."""
    keys = random_keys(rows.shape[-1], rows.device, kind)
    # A GPU has no products of whole matrices; on the processor they take half the time of sums.
    return rows @ keys if rows.device.type == "cpu" else (rows * keys).sum(-1)


def distinct_rows(rows: Tensor) -> tuple[Tensor, Tensor]:
    """First of each set of equal rows of small whole numbers ``[M, N]``; each row's set ``[M]``."""
    values, inverse = torch.unique(row_numbers(rows), return_inverse=True)
    first = torch.full((len(values),), len(rows), device=rows.device)
    first.scatter_reduce_(0, inverse, torch.arange(len(rows), device=rows.device), "amin")
    return first, inverse


def as_whole_numbers(values: Tensor) -> Tensor:
    """Numbers of any kind as whole ones of the same shape, equal where the numbers are equal."""
    if not values.is_floating_point():
        return values.long()
    bits = (values.float() + 0.0).contiguous().view(torch.int32).long()  # + 0.0: -0 is 0
    # With the halves swapped: as bits, small whole numbers end in zeros, and sums of multiples of
    # a power of two would sooner be equal by chance.
    return (bits >> 16) + ((bits & 0xFFFF) << 16)


def uniform_of(seed: int, *names: Tensor) -> Tensor:
    """Uniform numbers ``[...]`` in 0 to 1 that are a function of whole numbers ``[...]``.

    The same names have the same number, whatever else there is, and others independent ones, as far
    as anybody can tell: Steele, Lea and Flood's mixing of bits (SplitMix64, 2014).
    """
    device = names[0].device
    bits = mixed(torch.tensor(seed, dtype=torch.long, device=device), *names)
    return ((bits >> 40) & (2**24 - 1)).to(torch.float32) / 2**24


def mixed(*names: Tensor) -> Tensor:
    """Whole numbers ``[...]`` that are a function of others; sums of them tell sets apart."""
    bits = _mixed(names[0].long())
    for name in names[1:]:
        bits = _mixed(bits + name.long())
    return bits


def _mixed(bits: Tensor) -> Tensor:
    bits = bits - 0x61C8864680B583EB  # that is + 0x9E3779B97F4A7C15, as a signed number
    for shift, factor in ((30, -0x40A7B892E31B1A47), (27, -0x6B2FB644ECCEEE15)):
        bits = (bits ^ ((bits >> shift) & (2 ** (64 - shift) - 1))) * factor
    return bits ^ ((bits >> 31) & (2**33 - 1))

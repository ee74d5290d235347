"""Finding equal rows, which is where shared work comes from."""

from __future__ import annotations

import torch
from torch import Tensor


def random_keys(number: int, device: torch.device, kind: int = 0) -> Tensor:
    """Random 62-bit keys ``[number]``: sums of different sets of them differ.

    Sums of sums need keys of two kinds; with one kind, rows and columns could be exchanged.

    But for a chance of about one in 2**62, if what they are multiplied with is small, as masks
    and indices are. Sorting numbers is a hundred times quicker than sorting rows.
    """
    keys = torch.randint(2**62, (number,), generator=torch.Generator().manual_seed(kind))
    return keys.to(device)


def distinct_rows(rows: Tensor) -> tuple[Tensor, Tensor]:
    """First of each set of equal rows of small whole numbers ``[M, N]``; each row's set ``[M]``."""
    values, inverse = torch.unique(
        rows @ random_keys(rows.shape[1], rows.device), return_inverse=True
    )
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

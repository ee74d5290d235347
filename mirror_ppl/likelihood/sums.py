"""Sums of chosen numbers: what was recorded adds up along views, and along rounds."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag


@dataclass(frozen=True)
class Sums:
    """V sums a person, each of some of that person's N numbers.

    As a matrix nearly all entries would be zero. Each sum reads its numbers of all draws at once,
    which is many times as fast as gathering them draw by draw.

    Attributes:
        chosen: which of the P N numbers are added up, one sum after the other, ``[n]``.
        begins: where each of the P V sums begins ``[P V]``.
        shape: (P, V).
    """

    chosen: Tensor
    begins: Tensor
    shape: tuple[int, int]

    @classmethod
    def of(cls, chosen: Tensor, real: Tensor, number: int) -> Sums:
        """Sums of some of so many numbers.

        Args:
            chosen: of each person, ``[P, V, T]``.
            real: which of these count ``[P, V, T]``.
            number: N.
        """
        people, sums = chosen.shape[:2]
        begin = torch.arange(people, device=chosen.device)[:, None, None] * number
        length = real.sum(-1).flatten()
        return cls((chosen + begin)[real], length.cumsum(0) - length, (people, sums))

    def __call__(self, numbers: Tensor) -> Tensor:
        """The sums ``[..., P, V]`` of numbers ``[..., P, N]``."""
        draws = numbers.shape[:-2]
        rows = numbers.flatten(-2).reshape(draws.numel(), -1).T.contiguous()
        if not len(self.chosen):  # of padding alone
            return numbers.new_zeros(*draws, *self.shape)
        found = embedding_bag(self.chosen, rows, self.begins, mode="sum")
        return found.T.reshape(*draws, *self.shape)

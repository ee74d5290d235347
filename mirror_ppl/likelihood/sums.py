"""Sparse sums: log-likelihoods of recorded steps add up along views."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag


@dataclass(frozen=True)
class Sums:
    """V sums per person, each over a subset of that person's N numbers.

    As a matrix it would be nearly all zeros. Each sum reads its numbers of all draws at once, which
    is many times as fast as gathering them draw by draw.

    Attributes:
        chosen: indices into the P N numbers, one sum after the other, ``[n]``.
        begins: where each of the P V sums begins ``[P V]``.
        shape: (P, V).
    """

    chosen: Tensor
    begins: Tensor
    shape: tuple[int, int]

    @classmethod
    def of(cls, chosen: Tensor, real: Tensor, number: int) -> Sums:
        """Build the sums from padded indices.

        Args:
            chosen: indices of each person's numbers, ``[P, V, T]``.
            real: False in padding ``[P, V, T]``.
            number: numbers of a person N.
        """
        people, sums = chosen.shape[:2]
        begin = torch.arange(people, device=chosen.device)[:, None, None] * number
        length = real.sum(-1).flatten()
        return cls((chosen + begin)[real], length.cumsum(0) - length, (people, sums))

    def __call__(self, numbers: Tensor) -> Tensor:
        """The sums ``[..., P, V]`` of numbers ``[..., P, N]``."""
        draws = numbers.shape[:-2]
        rows = numbers.flatten(-2).reshape(draws.numel(), -1).T.contiguous()
        if not len(self.chosen):  # padding only
            return numbers.new_zeros(*draws, *self.shape)
        found = embedding_bag(self.chosen, rows, self.begins, mode="sum")
        return found.T.reshape(*draws, *self.shape)

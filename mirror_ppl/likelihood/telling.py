"""Which rounds tell most: gone through first, they spare others most of the combinations."""

from __future__ import annotations

import torch
from torch import Tensor

SAMPLE = 64
"""Combinations by which it is known which rounds tell most."""
MANY = 4 * SAMPLE
"""Combinations that are worth trying some of them first."""


def some_of(combinations: Tensor) -> Tensor:
    """A sample of combinations ``[M]``; always the same."""
    order = torch.randperm(len(combinations), generator=torch.Generator().manual_seed(0))
    return combinations[order[:SAMPLE].to(combinations.device)]


def telling_first(log_likelihoods: Tensor, log_prior: Tensor, margin: float) -> list[int]:
    """The order of rounds in which combinations fall behind the best ones soonest.

    Args:
        log_likelihoods: of rounds under policies and combinations, ``[S, R, M]``.
        log_prior: of combinations under policies, with rounds before, ``[S, M]``.
        margin: nats; who is as far behind is given up.

    Returns:
        Numbers of the R rounds.
    """
    total, left, order = log_prior, list(range(log_likelihoods.shape[1])), []
    while left:
        best = (total[:, None] + log_likelihoods[:, left]).amax(0)
        behind = (best.amax(-1, keepdim=True) - best).clamp(max=margin).sum(-1)
        order.append(left.pop(int(behind.argmax())))
        total = total + log_likelihoods[:, order[-1]]
    return order

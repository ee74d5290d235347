"""Order of rounds in screening: the most informative first, so that combinations drop early."""

from __future__ import annotations

import torch
from torch import Tensor

SAMPLE = 16
"""Combinations that determine the order of rounds. More take more time than they save."""
MANY = 16 * SAMPLE
"""Least number of combinations for which ordering the rounds pays."""


def some_of(combinations: Tensor) -> Tensor:
    """A random subset of combinations ``[M]``; deterministic."""
    order = torch.randperm(len(combinations), generator=torch.Generator().manual_seed(0))
    return combinations[order[:SAMPLE].to(combinations.device)]


def telling_first(log_likelihoods: Tensor, log_prior: Tensor, margin: float) -> list[int]:
    """The order of rounds in which combinations fall behind the best ones soonest.

    Args:
        log_likelihoods: log-likelihood of rounds under policies and combinations, ``[S, R, M]``.
        log_prior: log prior of combinations under policies, with earlier rounds, ``[S, M]``.
        margin: nats behind the best at which combinations are dropped.

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

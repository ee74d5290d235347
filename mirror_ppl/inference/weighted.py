"""Weighted draws of one person's implants, from which posterior draws are resampled."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mirror_ppl.likelihood.combination_sets import EquivalentCombinations
from mirror_ppl.models.prior import Draws

HIGH_PARETO_K = 0.7
"""Pareto k above which importance weights are unreliable (Vehtari et al., 2015)."""
NEGLIGIBLE = 1e-4
"""Posterior probability of the combinations that `Weighted.probable` leaves out."""
HALVINGS = 20
"""Bisection steps for the power to which weights are raised."""


@dataclass(frozen=True)
class Weighted:
    """Weighted draws of one person's implants.

    Attributes:
        policy: values of the sites that perception does not read, ``[S, 1, 1, ...]``.
        combinations: possible combinations of the sites that it reads; G sets.
        log_joint: log joint probability of each of these sets and the recorded actions under each
            draw, ``[S, G]``, up to a common constant.
        log_weights: normalized and Pareto-smoothed, ``[S]``.
        pareto_k: Pareto k of the weights.
        log_evidence: estimated log marginal likelihood of the recorded actions, nats.
        proposed_residual: True if the residual was proposed by its Laplace approximation.
        points: effective number of points (:mod:`mirror_ppl.likelihood.points`), if there are any.
    """

    policy: Draws
    combinations: EquivalentCombinations
    log_joint: Tensor
    log_weights: Tensor
    pareto_k: float
    log_evidence: float
    proposed_residual: bool = False
    points: float = math.inf

    @property
    def effective(self) -> float:
        """Effective number of draws."""
        return float(1 / self.log_weights.exp().square().sum())

    @property
    def evidence_error(self) -> float:
        """Approximate standard error of ``log_evidence``, nats."""
        of_draws = max(1 / self.effective - 1 / len(self.log_weights), 0.0)
        return (of_draws + 1 / self.points) ** 0.5

    def _of_sets(self) -> Tensor:
        """Posterior probability of each set of combinations ``[G]``."""
        counts = self.log_weights > -torch.inf
        given = torch.softmax(self.log_joint[counts].double(), -1)
        return self.log_weights[counts].double().exp() @ given

    def combination_probabilities(self) -> tuple[Tensor, Tensor]:
        """Numbers of the possible combinations ``[C]``, and their posterior probabilities."""
        sets, of_sets = self.combinations, self._of_sets()
        chance = sets.share.double().diff(prepend=sets.share.new_zeros(1).double())
        which = torch.arange(len(sets), device=chance.device).repeat_interleave(sets.sizes)
        total = torch.zeros_like(of_sets).index_add(0, which, chance)
        found = (of_sets / total.clamp(min=torch.finfo(total.dtype).tiny))[which] * chance
        return sets.members, found / found.sum()

    @property
    def probable(self) -> Tensor:
        """The combinations that together have all but `NEGLIGIBLE` of the probability, sorted."""
        probability = self._of_sets()
        best, order = probability.sort(descending=True)
        kept = torch.zeros_like(order, dtype=torch.bool)
        kept[order] = best.cumsum(0) - best < 1 - NEGLIGIBLE
        return self.combinations.kept(kept).members.sort().values

    def tempered(self, effective: float) -> Weighted:
        """Temper the weights until this many draws, at most a quarter of all, are effective.

        The power is 1 if possible.
        """
        effective = min(effective, len(self.log_weights) / 4)
        log_weights = tempered(self.log_weights, effective)
        return self if log_weights is self.log_weights else replace(self, log_weights=log_weights)

    def sample(self, number: int, values: Mapping[str, Tensor]) -> Draws:
        """Joint draws ``[number, 1, 1, ...]`` of all sites from the global random state.

        Args:
            number: number of draws.
            values: values of the sites that perception reads, for every combination ``[M, ...]``.
        """
        # Systematic resampling in random order repeats draws as little as possible.
        ladder = (torch.arange(number) + torch.rand(())) / number
        place = torch.searchsorted(self.log_weights.exp().cumsum(0), ladder.to(self.log_weights))
        place = place.clamp(max=len(self.log_weights) - 1)[torch.randperm(number)]
        # Inverse transform sampling, since multinomial is slow for many combinations.
        distinct, which = place.unique(return_inverse=True)
        ladder = torch.softmax(self.log_joint[distinct].double(), -1).cumsum(-1)[which]
        chosen = torch.searchsorted(ladder, ladder[:, -1:] * torch.rand_like(ladder[:, :1]))
        drawn = self.combinations.draw(chosen.clamp(max=ladder.shape[-1] - 1).squeeze(-1))
        perceived = {site: value[drawn][:, None, None] for site, value in values.items()}
        return {name: value[place] for name, value in self.policy.items()} | perceived


def tempered(log_weights: Tensor, effective: float) -> Tensor:
    """Raise normalized weights ``[n]`` to a power at which this many are effective; 1 if possible.

    Args:
        log_weights: their logarithms.
        effective: the effective number, less than n.
    """
    if float(1 / log_weights.exp().square().sum()) >= effective:
        return log_weights
    low, high = 2.0**-HALVINGS, 1.0
    for _ in range(HALVINGS):
        power = (low + high) / 2
        weights = torch.softmax(power * log_weights, 0)
        if float(1 / weights.square().sum()) >= effective:
            low = power
        else:
            high = power
    return torch.log_softmax(low * log_weights, 0)

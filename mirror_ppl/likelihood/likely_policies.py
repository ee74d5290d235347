"""Policies near a person: prior draws under which the rounds so far are most probable.

If no policy resembles the person, another can fit them best by chance, with wrong values of what
perception reads, and screening would drop the right ones. A few prior draws often miss a person;
among many, some resemble them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from mirror_ppl.likelihood.combinations import log_priors
from mirror_ppl.likelihood.policies import draw_policies
from mirror_ppl.likelihood.policy_likelihoods import PolicyLikelihoods
from mirror_ppl.likelihood.round_views import RoundViews
from mirror_ppl.likelihood.telling import some_of
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws

POOL, CHOSEN = 512, 16
"""Number of prior draws, and of those that are chosen."""
BEST = 32
"""Best combinations under which draws are compared, besides some at random."""
FIRST = 2
"""Number of rounds after which they are chosen; and again whenever there are twice as many."""

RoundSeen = tuple[RoundViews, tuple[Tensor, Tensor]]
"""Views of a round; numbers of the combinations that were alive then, and the view of each."""


class LikelyPolicies:
    """Policies under which one person's rounds so far are most probable.

    Args:
        human: the model of people, without round latents and ``stratified_by``.
        grid: values ``[M, ...]`` of the sites that perception reads, for each combination.
        seed: seed of the prior draws.

    Attributes:
        policies: values ``[S, 1, 1, ...]`` of its sites; empty before there are rounds enough.
    """

    def __init__(self, human: HumanModel, grid: Mapping[str, Tensor], seed: int) -> None:
        self.human = human
        self.grid = grid
        self.seed = seed
        self.policies: Draws = {}
        self._combinations = len(next(iter(grid.values()), (0,)))
        self._score = self._log_prior = torch.zeros(0)
        self._scored = self._chosen_after = 0

    def log_joint(
        self,
        rounds: Sequence[RoundSeen],
        alive: Tensor,
        best: Tensor,
    ) -> Tensor:
        """Log joint ``[S, M']`` of the rounds so far and the combinations, under each policy.

        Args:
            rounds: all rounds so far, those of earlier calls first.
            alive: numbers of the combinations ``[M']``; no others from now on.
            best: log joint of each under the best of other policies ``[M']``.
        """
        if len(rounds) >= max(FIRST, 2 * self._chosen_after):
            some = torch.cat([alive[best.topk(min(BEST, len(best))).indices], some_of(alive)])
            self._choose(rounds, some.unique())
        if not self.policies:
            return best.new_zeros(0, len(alive))
        new = rounds[self._scored :]
        self._score[:, alive] += self._log_likelihoods(self.policies, new, alive)
        self._scored = len(rounds)
        return (self._score + self._log_prior)[:, alive]

    def _choose(self, rounds: Sequence[RoundSeen], some: Tensor) -> None:
        """Choose policies under which rounds are most probable, if only ``some`` are alive."""
        drawn = draw_policies(self.human, self.grid, POOL, self.seed, distinct=True)
        if drawn is None:  # no prior draws represent the program
            return
        score = self._log_likelihoods(drawn, rounds, some).logsumexp(-1)
        likely = score.topk(min(CHOSEN, len(score))).indices
        self.policies = {name: policy[likely] for name, policy in drawn.items()}
        others = {site: own for site, own in self.policies.items() if site not in self.grid}
        self._log_prior = log_priors(self.human, self.grid, others, 1)[:, 0]
        self._score = self._log_prior.new_zeros(len(likely), self._log_prior.shape[-1])
        self._scored, self._chosen_after = 0, len(rounds)

    def _log_likelihoods(
        self,
        policies: Draws,
        rounds: Sequence[RoundSeen],
        combinations: Tensor,
    ) -> Tensor:
        """Log-likelihoods of rounds under policies and combinations, ``[S, M']``."""
        likelihoods = PolicyLikelihoods(self.human, policies, len(next(iter(policies.values()))))
        total = combinations.new_zeros((), dtype=torch.float32)
        for part, (numbers, seen) in rounds:
            view = seen.new_zeros(self._combinations)
            view[numbers] = seen
            needed, place = view[combinations].unique(return_inverse=True)
            total = total + likelihoods.of_views(part.kept(needed))[:, place]
        return total

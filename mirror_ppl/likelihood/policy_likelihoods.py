"""Log-likelihoods of recorded actions under policies, and moments that these do not tell apart.

Policies are draws of the implants that perception does not read. They decide which combinations of
the others are dropped, and which moments of a round count as one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.likelihood.attention import AttentionValues
from mirror_ppl.likelihood.densities import choices, log_weighted_latents
from mirror_ppl.likelihood.round_views import ManyViews, RoundViews, distinct_in_groups
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.sums import Sums
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models.belief_tracking import CHUNK
from mirror_ppl.models.human import HumanModel

KINDS_MERGE = 32
"""Policies that distinguish moments if people are of several kinds; total over kinds."""


@dataclass(frozen=True)
class PolicyLikelihoods:
    """Log-likelihoods under policies.

    Attributes:
        human: the human model.
        policies: values ``[policies, 1, 1, ...]`` of its sites; empty if actions depend on none.
        number: number of policies.
    """

    human: HumanModel
    policies: Mapping[str, Tensor]
    number: int

    def merged(
        self, views: ManyViews, policies: Mapping[str, Tensor], resolution: float
    ) -> tuple[ManyViews, Tensor]:
        """Merge moments of rounds that policies do not tell apart.

        Args:
            views: of rounds.
            policies: see :meth:`merging`.
            resolution: see :class:`Screening`.

        Returns:
            The views, and the new number of each former one ``[V]``.
        """
        if not len(views.acted):  # padding only
            return views, torch.arange(len(views.moments), device=views.moments.device)
        every = torch.arange(len(views.acted), device=views.acted.device)
        found = torch.cat(
            [self._of_moments(policies, views, some).T for some in every.split(CHUNK)]
        )
        # Where an action is impossible under a policy, nothing is known of similar policies.
        alone = torch.where(found.isneginf().any(-1), every + 1, 0)
        key = (found / resolution).round_().nan_to_num_(neginf=0.0).long()
        # Moments with different actions stay apart: each has one entry of ``acted``.
        key = torch.cat([key, views.acted[:, None], alone[:, None]], -1)
        first, cluster = distinct_in_groups(key, views.rounds)
        moments = views.moments
        moments = torch.where(moments == NO_VIEW, NO_VIEW, cluster[moments.clamp(min=0)])
        distinct, place = distinct_in_groups(moments, views.views)
        kept = ManyViews(
            moments[distinct],
            views.belief[first],
            views.values[first],
            views.acted[first],
            views.views[distinct],
            views.rounds[first],
            views.number,
        )
        return kept, place

    def merging(self, screening: Screening) -> dict[str, Tensor]:
        """Return policies that distinguish moments; twice as many if there are kinds of people."""
        kinds = self.number // screening.policies
        number = kinds * (screening.merge_policies if kinds == 1 else max(1, KINDS_MERGE // kinds))
        return {name: policy[:number] for name, policy in self.policies.items()}

    def of_views(
        self, views: ManyViews | RoundViews, policies: Mapping[str, Tensor] | None = None
    ) -> Tensor:
        """Return those of the recorded actions under each policy and view, ``[policies, V]``.

        Args:
            views: of rounds.
            policies: other policies, such as some of them; all unless given.
        """
        if not len(views.acted):  # padding only
            return views.values.new_zeros(self.number, len(views.moments))
        moments = views.moments[None]
        along = Sums.of(moments, moments != NO_VIEW, len(views.acted))
        policies = self.policies if policies is None else policies
        return along(self._of_moments(policies, views)[:, None])[:, 0]

    def with_attention(self, likelihoods: Tensor, attended: AttentionValues) -> Tensor:
        """Return log joints ``[policies, U, G]`` of actions and attention."""
        values = {name: value[None, None] for name, value in attended.values.items()}
        with self.conditioned():
            implants = self.human.prior()
            probabilities = log_weighted_latents(
                self.human, implants, values, attended.log_weights[None, None], attended.covariates
            )
        return likelihoods + probabilities[:, 0]

    def _of_moments(
        self,
        policies: Mapping[str, Tensor],
        views: ManyViews | RoundViews,
        some: Tensor | slice = slice(None),
    ) -> Tensor:
        """Return those ``[policies, N]`` of the record at some moments."""
        moments = (one[None, some] for one in (views.belief, views.values, views.acted))
        with self.conditioned(policies) as number:
            _, found = choices(self.human, self.human.prior(), *moments)
        # If actions depend on no implant, they are the same under every policy.
        return found.expand(number, *found.shape[-2:])[:, 0]

    @contextmanager
    def conditioned(self, policies: Mapping[str, Tensor] | None = None) -> Iterator[int]:
        """Condition the program on policies, one draw each; yields their number."""
        policies = self.policies if policies is None else policies
        number = len(next(iter(policies.values()))) if policies else self.number
        with (
            poutine.block(),
            poutine.condition(data=dict(policies)),
            pyro.plate("policy", number, dim=-3),
            pyro.plate("person", 1, dim=-2),
        ):
            yield number

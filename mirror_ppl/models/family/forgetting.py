"""A model of people who forget what they saw and heard."""

from __future__ import annotations

from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.errors import HumanModelError
from mirror_ppl.models.family.several import NOW, SeveralBeliefs, joined
from mirror_ppl.models.human import Implants
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.view import View

FORGETS = "forgets"
"""Site of the probability of forgetting, at a step, everything before it."""
FORGOT = ("forgot 0", "forgot 1", "forgot 2")
"""Beliefs after forgetting everything before this step, the last step, and the one before that."""
AFRESH = "afresh"
"""The view of a person with no knowledge from earlier steps."""


class Forgetting(SeveralBeliefs):
    """Forgets, at each step with some probability, everything seen and heard before it::

        forgets_p ~ Beta(1, 1)
        zH_t^m    the belief given this step and the m before it alone: m = 0, 1, 2
        a_t       ~ sum_m forgets (1 - forgets)^m p(a | zH_t^m) + (1 - forgets)^3 p(a | zH_t)

    A person who has not forgotten for more than two steps has the full belief ``zH_t``.
    """

    def __init__(self, self_model: SelfModel) -> None:
        super().__init__(self_model)
        if len(self.domain.reach_bins) <= 1:
            raise HumanModelError(
                f"forgetting: in {self.domain.name} items stay in view once they are found, so "
                "there is nothing to forget"
            )

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views, with that of a person with no earlier knowledge."""
        return (*super().views, AFRESH)

    @property
    def beliefs(self) -> tuple[str, ...]:
        """Names of the beliefs, with those after forgetting."""
        return (*super().beliefs, *FORGOT)

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, with the probability ``forgets``."""
        one = next(self.self_model.parameters()).new_ones(())
        return super().prior() | {FORGETS: pyro.sample(FORGETS, dist.Beta(one, one))}

    def perceive(
        self,
        implants: Implants,
        knowledge: Any,
        observation: Observation,
        told: Visibility,
        step: int,
    ) -> tuple[View, Any]:
        """Return the views with and without knowledge from earlier steps."""
        nothing = super().nothing_known(1, device=observation["ego"].device)
        afresh, _ = super().perceive(implants, nothing, observation, told, step)
        view, after = super().perceive(implants, knowledge, observation, told, step)
        return joined({NOW: view, AFRESH: afresh}), after

    def after(self, before, evidence, action, still) -> dict[str, Tensor]:
        """Return the beliefs after one step; after forgetting just now, as at a first step."""
        found = super().after(before, evidence, action, still)
        begins = torch.full_like(action, len(self.domain.actions))
        nothing = torch.zeros_like(before[NOW])
        found[FORGOT[0]] = self.inferred(nothing, evidence[AFRESH], begins, still)
        for name, own in zip(FORGOT[1:], FORGOT, strict=False):
            later = self.inferred(before[own], evidence[AFRESH], action, still)
            first = (action == len(self.domain.actions))[..., None]
            found[name] = torch.where(first, found[FORGOT[0]], later)
        return found

    def shares(self, implants: Implants) -> dict[str, Tensor]:
        """Return the probabilities of acting on each belief, with those after forgetting."""
        found, forgets = super().shares(implants), implants[FORGETS]
        left = found[NOW]
        for name in FORGOT:
            found[name] = left * forgets
            left = left - found[name]
        return found | {NOW: left}

"""A model of people who notice items in reach with some probability."""

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
from mirror_ppl.models.perception import perceived_by
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.view import View

NOTICES = "notices"
"""Site of the probability of noticing, at a step, the items in reach."""
MISSED = ("missed 1", "missed 2")
"""Beliefs after noticing nothing at this step; at this and the one before."""
UNNOTICED = "unnoticed"
"""The view of a person who notices nothing: messages, and what they already know."""


class Noticing(SeveralBeliefs):
    """Notices items in reach with some probability at each step, else uses known items only::

        notices_p ~ Beta(1, 1)
        zH_t^m    the belief if nothing was noticed for m steps: 1, or 2 and more
        a_t       ~ sum_m notices (1 - notices)^m p(a | zH_t^m)

    A person who notices again notices all items in reach. Messages are always noticed.
    """

    def __init__(self, self_model: SelfModel) -> None:
        super().__init__(self_model)
        if len(self.domain.reach_bins) <= 1:
            raise HumanModelError(
                f"noticing: in {self.domain.name} distance does not matter, and the model "
                '"mirror" already includes when items are noticed'
            )

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views, with that of a person who notices nothing."""
        return (*super().views, UNNOTICED)

    @property
    def beliefs(self) -> tuple[str, ...]:
        """Names of the beliefs, with those after noticing nothing."""
        return (*super().beliefs, *MISSED)

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, with the probability ``notices``."""
        one = next(self.self_model.parameters()).new_ones(())
        return super().prior() | {NOTICES: pyro.sample(NOTICES, dist.Beta(one, one))}

    def perceive(
        self,
        implants: Implants,
        knowledge: Any,
        observation: Observation,
        told: Visibility,
        step: int,
    ) -> tuple[View, Any]:
        """Return the views if the items in reach are noticed and if not."""

        def nothing(seen: Observation) -> Visibility:
            return {
                name: torch.zeros(value.shape[:-1], dtype=torch.bool, device=value.device)
                for name, value in seen.items()
                if name != "ego"
            }

        view, after = super().perceive(implants, knowledge, observation, told, step)
        missed, _ = perceived_by(nothing, self.domain, implants, knowledge, observation, told)
        return joined({NOW: view, UNNOTICED: missed}), after

    def after(self, before, evidence, action, still) -> dict[str, Tensor]:
        """Return the beliefs after one step, also if nothing was noticed for one step or two."""
        found = super().after(before, evidence, action, still)
        for name, own in zip(MISSED, (NOW, *MISSED), strict=False):
            found[name] = self.inferred(before[own], evidence[UNNOTICED], action, still)
        return found

    def shares(self, implants: Implants) -> dict[str, Tensor]:
        """Return the probabilities of acting on each belief, with those after noticing nothing."""
        found, notices = super().shares(implants), implants[NOTICES]
        once, more = (found[NOW] * (1 - notices) * part for part in (notices, 1 - notices))
        return found | {NOW: found[NOW] * notices} | dict(zip(MISSED, (once, more), strict=True))

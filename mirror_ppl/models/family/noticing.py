"""A model of people who notice items in reach with some probability."""

from __future__ import annotations

from dataclasses import dataclass
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
MISSED = ("missed 1", "missed 2", "missed 3")
"""Beliefs after noticing nothing at this step, and at one or two before."""
UNNOTICED = ("unnoticed 1", "unnoticed 2", "unnoticed 3")
"""Views of a person who notices nothing: messages, and what they knew before these steps."""


@dataclass(frozen=True)
class Known:
    """Knowledge after noticing what is in reach at this step, or not for one step or two.

    Attributes:
        noticed: the knowledge of a person who notices everything in reach.
        missed_1: that of one who noticed nothing at this step.
        missed_2: that of one who noticed nothing at this step and the one before.
    """

    noticed: Any
    missed_1: Any
    missed_2: Any


class Noticing(SeveralBeliefs):
    """Notices items in reach with some probability at each step, else uses known items only::

        notices_p ~ Beta(1, 1)
        zH_t^m    the belief if nothing was noticed for m steps: 1, 2, or 3 and more
        a_t       ~ sum_{m<3} notices (1 - notices)^m p(a | zH_t^m) + (1 - notices)^3 p(a | zH_t^3)

    A person who notices again notices all items in reach, also those that were missed. Messages
    are always noticed.
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
        """Names of the views, with those of a person who notices nothing."""
        return (*super().views, *UNNOTICED)

    @property
    def beliefs(self) -> tuple[str, ...]:
        """Names of the beliefs, with those after noticing nothing."""
        return (*super().beliefs, *MISSED)

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, with the probability ``notices``."""
        one = next(self.self_model.parameters()).new_ones(())
        return super().prior() | {NOTICES: pyro.sample(NOTICES, dist.Beta(one, one))}

    def nothing_known(self, *batch: int, device: torch.device | None = None) -> Known:
        """Return what people know before a round, whatever they will notice."""
        nothing = super().nothing_known(*batch, device=device)
        return Known(nothing, nothing, nothing)

    def perceive(
        self,
        implants: Implants,
        knowledge: Known,
        observation: Observation,
        told: Visibility,
        step: int,
    ) -> tuple[View, Known]:
        """Return the views if the items in reach are noticed and if not, and knowledge after."""

        def nothing(seen: Observation) -> Visibility:
            return {
                name: torch.zeros(value.shape[:-1], dtype=torch.bool, device=value.device)
                for name, value in seen.items()
                if name != "ego"
            }

        view, noticed = super().perceive(implants, knowledge.noticed, observation, told, step)
        views, known = {NOW: view}, [noticed]
        before = (knowledge.noticed, knowledge.missed_1, knowledge.missed_2)
        for name, own in zip(UNNOTICED, before, strict=True):
            views[name], after = perceived_by(
                nothing, self.domain, implants, own, observation, told
            )
            known.append(after)
        return joined(views), Known(*known[:-1])

    def after(self, before, evidence, action, still) -> dict[str, Tensor]:
        """Return the beliefs after one step, also if nothing was noticed for one to three steps."""
        found = super().after(before, evidence, action, still)
        for name, view, own in zip(MISSED, UNNOTICED, (NOW, *MISSED[:-1]), strict=True):
            found[name] = self.inferred(before[own], evidence[view], action, still)
        return found

    def shares(self, implants: Implants) -> dict[str, Tensor]:
        """Return the probabilities of acting on each belief, with those after noticing nothing."""
        found, notices = super().shares(implants), implants[NOTICES]
        left = found[NOW]
        for name in (NOW, *MISSED[:-1]):
            found[name] = left * notices
            left = left - found[name]
        return found | {MISSED[-1]: left}

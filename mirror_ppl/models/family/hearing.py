"""People who do not hear."""

from __future__ import annotations

from typing import Any

import pyro
import pyro.distributions as dist
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.view import View

HEARS = "hears_"
"""What sites begin with of whether messages of a modality reach somebody."""


class HardOfHearing(HumanModel):
    """Does not take in what is communicated by some channels: ``hears_<modality>``, 1 if they do.

    It is inferred from recordings with messages, such as rounds in which a communicator assists.
    """

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, and the channels that reach them."""
        even = next(self.self_model.parameters()).new_full((2,), 1 / 2)
        hears = {
            site: pyro.sample(site, dist.Categorical(even))
            for site in (HEARS + modality.name for modality in self.domain.modalities)
        }
        return super().prior() | hears

    def perceive(
        self,
        implants: Implants,
        knowledge: Any,
        observation: Observation,
        told: Visibility,
        step: int,
    ) -> tuple[View, Any]:
        """What a person sees, and of what is communicated what reaches them."""
        reaches = {
            name: mask & (implants[HEARS + name][..., None] == 1) for name, mask in told.items()
        }
        return super().perceive(implants, knowledge, observation, reaches, step)

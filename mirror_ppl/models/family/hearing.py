"""A model of people whom messages may not reach."""

from __future__ import annotations

from typing import Any

import pyro
import pyro.distributions as dist
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.view import View

HEARS = "hears_"
"""Prefix of the sites of whether messages of a modality reach the person."""


class HardOfHearing(HumanModel):
    """Misses messages through some channels: ``hears_<modality>`` is 1 if messages reach them.

    Only recordings with messages identify it, such as rounds in which a communicator assists.
    """

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, with the channels that reach them."""
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
        """Return the view, with only the messages that reach the person."""
        reaches = {
            name: mask & (implants[HEARS + name][..., None] == 1) for name, mask in told.items()
        }
        return super().perceive(implants, knowledge, observation, reaches, step)

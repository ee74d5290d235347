"""A person who sees less for a step after switching lanes: a human model with its own memory.

    python -m mirror_ppl.fit --human-model docs/examples/looks_away.py:LooksAway

At the step after a switch, thresholds of sight are ``blur`` bins nearer::

    blur_p ~ Categorical(.4, .2, .2, .2)

``docs/extending.md`` explains how to write such a class.
"""

from collections import ChainMap
from dataclasses import dataclass
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.models import HumanModel, View


@dataclass
class Memory:
    """What a person remembers: cars, as the package's model does, and the lane."""

    cars: Any
    lane: Tensor  # of the step before [...]; -1 before the first


class LooksAway(HumanModel):
    """The package's human model, with a discrete site more that ``perceive`` reads."""

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person; ``blur`` is in bins of sight."""
        shares = torch.tensor([0.4, 0.2, 0.2, 0.2])
        return super().prior() | {"blur": pyro.sample("blur", dist.Categorical(shares))}

    def nothing_known(self, *batch: int, device: torch.device | None = None) -> Memory:
        """Return the memory before a round."""
        lane = torch.full(batch, -1.0, device=device)
        return Memory(super().nothing_known(*batch, device=device), lane)

    def perceive(self, implants, knowledge, observation, told, step) -> tuple[View, Memory]:
        """Perceive with nearer thresholds where the lane is not that of the step before."""
        lane = observation["ego"][..., 0]
        switched = (knowledge.lane >= 0) & (lane != knowledge.lane)
        blur = torch.where(switched, implants["blur"], 0)
        sites = [f"sight_{direction}" for direction in self.domain.directions]
        nearer = {site: (implants[site] - blur).clamp(min=0) for site in sites}
        # Not a copy of all implants, which would count as read.
        now = ChainMap(nearer, implants)
        view, cars = super().perceive(now, knowledge.cars, observation, told, step)
        return view, Memory(cars, lane)

"""An observer's knowledge of each car, and assumptions about the others.

One sight of a car reveals its position; a second sight or an utterance reveals its speed, which is
then known for the rest of the round because cars keep their speed. A car seen once has one of two
speeds; if it would be in sight had it come closer and is not, it has the other speed. Until then
the observer may assume that it comes closer, and that cars never observed are absent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility

ROAD_END = 12
"""Distance in cells at which the visible road ends, ahead and behind."""
ASSUMPTIONS = ("clear", "closing")
"""Cars never observed are absent; cars with known position and unknown speed come closer."""


@dataclass(frozen=True)
class CarKnowledge:
    """Knowledge of each car ``[..., 4]`` at one step.

    Attributes:
        placed: observed at this step or before.
        known: position and speed follow from observations.
        position: for cars placed but not known, cells ahead if they came closer since; else 0.
        speed: the speed at which such cars would come closer, cells a step; else 0.
    """

    placed: Tensor
    known: Tensor
    position: Tensor
    speed: Tensor

    @classmethod
    def nothing(cls, *batch: int, device: torch.device | None = None) -> CarKnowledge:
        """Return the knowledge before anything was observed."""
        never = torch.zeros(*batch, 4, dtype=torch.bool, device=device)
        zero = torch.zeros(*batch, 4, device=device)
        return cls(never, never, zero, zero)

    @property
    def unsure(self) -> Tensor:
        """Cars ``[..., 4]`` with an observed position and an unknown speed."""
        return self.placed & ~self.known

    def learn(
        self,
        observation: Observation,
        visible: Visibility,
        sees: Callable[[Observation], Visibility],
    ) -> CarKnowledge:
        """Return the knowledge one step later; see `mirror_ppl.domains.base.Domain.learn`."""
        ahead = observation["visual"][..., 0]
        # Off the road there is nothing to observe, whatever the reach.
        here = ahead.abs() < ROAD_END
        shown, spoken = visible["visual"] & here, visible["verbal"] & here
        position = self.position + self.speed
        expected = assumed_cars(position, self.speed, observation)
        missed = sees(expected)["visual"] & (position.abs() < ROAD_END) & ~shown
        known = self.known | spoken | (self.placed & shown) | (self.unsure & missed)
        placed = self.placed | shown | spoken
        first = placed & ~self.placed
        # A car abreast came from behind: from ahead it would have been observed there before.
        closing = torch.where(ahead > 0, -1.0, 1.0).to(position.dtype)
        unsure = placed & ~known
        return CarKnowledge(
            placed,
            known,
            torch.where(unsure, torch.where(first, ahead, position), 0.0),
            torch.where(unsure, torch.where(first, closing, self.speed), 0.0),
        )


def assumed_cars(position: Tensor, speed: Tensor, observation: Observation) -> Observation:
    """Return the full observation with cars at assumed positions ``[..., 4]``."""
    offset = observation["visual"][..., 1]
    position, speed, offset = torch.broadcast_tensors(position, speed, offset)
    seen = position.clamp(-ROAD_END, ROAD_END)
    speed = torch.where(seen.abs() < ROAD_END, speed, 0.0)
    return {
        "ego": observation["ego"],
        "visual": torch.stack([seen, offset], -1),
        "verbal": torch.stack([seen, offset, speed], -1),
    }

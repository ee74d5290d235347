"""What an observer has learned of each car, and what they take for granted about the others.

One sight of a car tells where it is; a second one, or an utterance, tells how it moves, and as cars
keep their speed that is known for the rest of the round. So it is if a car that was seen once would
be in sight by now had it come closer, and is not: there are two speeds, and it has the other one.
Until then the observer may assume that it comes closer, and of cars never observed that there are
none.
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
"""Cars never observed are absent; cars of which only the place is known come closer."""


@dataclass(frozen=True)
class CarKnowledge:
    """Of each car ``[..., 4]``, at one step.

    Attributes:
        placed: observed at this step or before.
        known: place and speed follow from what was observed.
        position: of a car placed but not known, cells ahead if it has come closer since; else 0.
        speed: the speed at which such a car would come closer, cells a step; else 0.
    """

    placed: Tensor
    known: Tensor
    position: Tensor
    speed: Tensor

    @classmethod
    def nothing(cls, *batch: int, device: torch.device | None = None) -> CarKnowledge:
        """Before anything was observed."""
        never = torch.zeros(*batch, 4, dtype=torch.bool, device=device)
        zero = torch.zeros(*batch, 4, device=device)
        return cls(never, never, zero, zero)

    @property
    def unsure(self) -> Tensor:
        """Cars ``[..., 4]`` of which the place was observed and the speed is not known."""
        return self.placed & ~self.known

    def learn(
        self,
        observation: Observation,
        visible: Visibility,
        sees: Callable[[Observation], Visibility],
    ) -> CarKnowledge:
        """Knowledge one step later; see `mirror_ppl.domains.base.Domain.learn`."""
        ahead = observation["visual"][..., 0]
        # Off the road there is nothing to observe, however far somebody sees.
        here = ahead.abs() < ROAD_END
        shown, spoken = visible["visual"] & here, visible["verbal"] & here
        position = self.position + self.speed
        expected = assumed_cars(position, self.speed, observation)
        missed = sees(expected)["visual"] & (position.abs() < ROAD_END) & ~shown
        known = self.known | spoken | (self.placed & shown) | (self.unsure & missed)
        placed = self.placed | shown | spoken
        first = placed & ~self.placed
        # One that came from ahead would have been ahead before: a car abreast came from behind.
        closing = torch.where(ahead > 0, -1.0, 1.0).to(position.dtype)
        unsure = placed & ~known
        return CarKnowledge(
            placed,
            known,
            torch.where(unsure, torch.where(first, ahead, position), 0.0),
            torch.where(unsure, torch.where(first, closing, self.speed), 0.0),
        )


def assumed_cars(position: Tensor, speed: Tensor, observation: Observation) -> Observation:
    """What there would be to observe now of cars at assumed places ``[..., 4]``."""
    offset = observation["visual"][..., 1]
    position, speed, offset = torch.broadcast_tensors(position, speed, offset)
    seen = position.clamp(-ROAD_END, ROAD_END)
    speed = torch.where(seen.abs() < ROAD_END, speed, 0.0)
    return {
        "ego": observation["ego"],
        "visual": torch.stack([seen, offset], -1),
        "verbal": torch.stack([seen, offset, speed], -1),
    }

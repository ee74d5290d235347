"""A firefighter's knowledge of the house.

Nothing in the house moves but the firefighter, and the victim once found. So what a portion of the
map or a message showed is known for the rest of the round, with its implications: at most one
corridor is blocked, and there is one victim. The house itself is known from the beginning: portions
that look the same in every scenario carry no information.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility

PORTION_COUNT = 9
CORRIDOR_PORTIONS, ROOM_PORTIONS = (3, 5), (0, 1, 2)
"""Portions of the map with the left and the right corridor, and with each room."""


@dataclass(frozen=True)
class HouseKnowledge:
    """Knowledge of each corridor ``[..., 2]`` and room ``[..., 3]`` at one step.

    Attributes:
        corridors: whether it is known if they are blocked.
        rooms: whether it is known if the victim is there.
    """

    corridors: Tensor
    rooms: Tensor

    @classmethod
    def nothing(cls, *batch: int, device: torch.device | None = None) -> HouseKnowledge:
        """Return the knowledge before anything was observed."""
        return cls(
            torch.zeros(*batch, len(CORRIDOR_PORTIONS), dtype=torch.bool, device=device),
            torch.zeros(*batch, len(ROOM_PORTIONS), dtype=torch.bool, device=device),
        )

    def learn(self, observation: Observation, visible: Visibility) -> HouseKnowledge:
        """Return the knowledge one step later; see `mirror_ppl.domains.base.Domain.learn`."""
        number = len(CORRIDOR_PORTIONS)
        shown, spoken = visible["visual"], visible["verbal"]
        holds = observation["verbal"][..., 0] == 1
        corridors = self.corridors | spoken[..., :number] | shown[..., list(CORRIDOR_PORTIONS)]
        rooms = self.rooms | spoken[..., number:] | shown[..., list(ROOM_PORTIONS)]
        # If one corridor is blocked, the other is not.
        blocked = (corridors & holds[..., :number]).any(-1, keepdim=True)
        # The victim is known to be in one room, to be in none of the others, or is carried.
        there = (rooms & holds[..., number:]).any(-1, keepdim=True)
        carried = observation["ego"][..., 2:] == 1
        left = (~rooms).sum(-1, keepdim=True) == 1
        return HouseKnowledge(corridors | blocked, rooms | there | carried | left)

    def items(self) -> Visibility:
        """Return portions ``[..., 9]`` and utterances ``[..., 5]`` whose content is known."""
        both = torch.cat([self.corridors, self.rooms], -1)
        portions = torch.ones(*both.shape[:-1], PORTION_COUNT, dtype=torch.bool, device=both.device)
        portions[..., [*CORRIDOR_PORTIONS, *ROOM_PORTIONS]] = both
        return {"visual": portions, "verbal": both}

"""What a firefighter's moves lead to and earn, and the exact values of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor

from mirror_ppl.domains.search_rescue.house import (
    CORRIDORS,
    ROOMS,
    SIDE,
    at_entrance,
    walkable,
)

MOVES = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}
FOUND, RETURNED, COLLISION, TIME = 1.0, 15.0, -10.0, -0.1


@dataclass(frozen=True)
class RescueState:
    """State of a batch of rounds.

    Attributes:
        place: row and column of the firefighter ``[..., 2]``, in cells.
        found: whether the victim was found ``[...]``.
        home: whether they are back at the entrance ``[...]``.
        blocked: corridor that is blocked ``[...]``: 0 none, 1 left, 2 right.
        victim: room of the victim ``[...]``, an index into ``ROOMS``.
    """

    place: Tensor
    found: Tensor
    home: Tensor
    blocked: Tensor
    victim: Tensor


def at_victim(state: RescueState, place: Tensor) -> Tensor:
    """Return where a place ``[..., 2]`` is that of the victim ``[...]``."""
    rooms = torch.tensor(list(ROOMS.values()), device=place.device)
    return (place == rooms[state.victim]).all(-1)


def obstructed(state: RescueState, place: Tensor) -> Tensor:
    """Return where a place ``[..., 2]`` is that of the obstacle ``[...]``."""
    corridors = torch.tensor([(-1, -1), *CORRIDORS.values()], device=place.device)
    return (place == corridors[state.blocked]).all(-1)


def moved(state: RescueState, action: Tensor) -> RescueState:
    """Return the state at t + 1; ``action`` ``[...]`` is an index into ``MOVES``."""
    moves = torch.tensor(list(MOVES.values()), device=state.place.device)
    target = state.place + moves[action]
    stays = state.home | ~walkable(target) | obstructed(state, target)
    place = torch.where(stays[..., None], state.place, target)
    found = state.found | at_victim(state, place)
    home = state.home | (found & at_entrance(place))
    return replace(state, place=place, found=found, home=home)


def earned(state: RescueState, action: Tensor, following: RescueState) -> dict[str, Tensor]:
    """Return reward terms ``[...]`` by name, in units of reward."""
    moves = torch.tensor(list(MOVES.values()), device=state.place.device)
    into = obstructed(state, state.place + moves[action])
    dtype = torch.get_default_dtype()
    return {
        "found": FOUND * (following.found & ~state.found).to(dtype),
        "returned": RETURNED * (following.home & ~state.home).to(dtype),
        "collision": COLLISION * into.to(dtype),
        "time": TIME * (~state.home).to(dtype),
    }


@cache
def action_values(discount: float) -> Tensor:
    """Compute ``[blocked 3, victim 3, found 2, row 9, column 9, action 4]`` by value iteration."""
    shape = (1 + len(CORRIDORS), len(ROOMS), 2, SIDE, SIDE)
    grid = torch.cartesian_prod(*(torch.arange(size) for size in shape))
    blocked, victim, found, row, column = grid.unbind(-1)
    number, actions = len(grid), len(MOVES)
    state = RescueState(
        torch.stack([row, column], -1), found.bool(), torch.zeros(number).bool(), blocked, victim
    )
    outcomes = []
    for action in range(actions):
        chosen = torch.full((number,), action)
        after = moved(state, chosen)
        reward = torch.stack(list(earned(state, chosen, after).values())).sum(0)
        strides = torch.tensor([shape[1] * 2 * SIDE**2, 2 * SIDE**2, SIDE**2, SIDE, 1])
        parts = [after.blocked, after.victim, after.found.long(), *after.place.unbind(-1)]
        outcomes.append((reward.double(), (torch.stack(parts, -1) * strides).sum(-1), after.home))
    # Cells inside walls have no transitions.
    floor = walkable(state.place)
    values = torch.zeros(number, dtype=torch.double)
    while True:
        following = torch.stack(
            [
                reward + discount * torch.where(home, 0.0, values[index])
                for reward, index, home in outcomes
            ],
            -1,
        )
        following = torch.where(floor[:, None], following, 0.0)
        best = following.amax(-1)
        if torch.equal(best, values):
            return following.view(*shape, actions).to(torch.get_default_dtype())
        values = best

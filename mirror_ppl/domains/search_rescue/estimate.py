"""States and possible observations of search and rescue, given complete observations."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation
from mirror_ppl.domains.search_rescue.house import (
    CORRIDORS,
    ROOMS,
    SIDE,
    at_entrance,
    walkable,
)
from mirror_ppl.domains.search_rescue.moves import RescueState


def state_of(observation: Observation) -> RescueState:
    """Return the state ``[...]`` with this full observation.

    The former room of a carried victim cannot be observed and no longer matters.
    """
    holds = observation["verbal"][..., 0].round().bool()
    place = observation["ego"][..., :2].round().long()
    found = observation["ego"][..., 2].round().bool()
    sides = torch.arange(1, 1 + len(CORRIDORS), device=place.device)
    rooms = torch.arange(len(ROOMS), device=place.device)
    return RescueState(
        place=place,
        found=found,
        home=found & at_entrance(place),
        blocked=(holds[..., : len(sides)] * sides).sum(-1),
        victim=(holds[..., len(sides) :] * rooms).sum(-1),
    )


def nearest_to(
    observation: Observation, observe: Callable[[RescueState], Observation]
) -> Observation:
    """Return the possible observation nearest to decoded values.

    Places are rounded to the nearest floor. The scenario is the one with the nearest pixels and
    utterances.

    Args:
        observation: decoded values.
        observe: the observation of a state.
    """
    place = observation["ego"][..., :2]
    cells = torch.cartesian_prod(torch.arange(SIDE), torch.arange(SIDE))
    cells = cells[walkable(cells)].to(place.device)
    apart = (place[..., None, :] - cells.to(place)).pow(2).sum(-1)
    carrying = observation["ego"][..., 2] >= 0.5  # noqa: PLR2004 - between no and yes
    corridors, rooms = 1 + len(CORRIDORS), len(ROOMS)
    blocked, victim = torch.cartesian_prod(torch.arange(corridors), torch.arange(rooms)).T.to(
        place.device
    )
    batch = carrying.shape
    candidates = RescueState(
        place=cells[apart.argmin(-1)][..., None, :].expand(*batch, len(victim), 2),
        found=carrying[..., None].expand(*batch, len(victim)),
        home=torch.zeros(*batch, len(victim), dtype=torch.bool, device=place.device),
        blocked=blocked.expand(*batch, -1),
        victim=victim.expand(*batch, -1),
    )
    possible = observe(candidates)
    unlike = sum(
        (possible[name] - observation[name][..., None, :, :]).pow(2).flatten(-2).sum(-1)
        for name in ("visual", "verbal")
    )
    best = torch.as_tensor(unlike).argmin(-1)

    def chosen(part: Tensor) -> Tensor:
        index = best.view(*batch, 1, *(1,) * (part.dim() - len(batch) - 1))
        return part.take_along_dim(index, len(batch)).squeeze(len(batch))

    return {name: chosen(part) for name, part in possible.items()}

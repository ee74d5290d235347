"""The house of search and rescue: its map, its portions, and their pixels."""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

from mirror_ppl.domains.search_rescue.knowledge import CORRIDOR_PORTIONS, ROOM_PORTIONS

SIDE, PORTION = 9, 3
"""Cells along a side of the map, and of a portion of it."""
HOUSE = (
    ".........",
    ".........",
    ".........",
    "#.#####.#",
    "#.#####.#",
    "#.#####.#",
    ".........",
    ".........",
    ".........",
)
ENTRANCE = (8, 4)
ROOMS = {"top-left": (1, 1), "top-middle": (1, 4), "top-right": (1, 7)}
"""Possible places of the victim, by room."""
CORRIDORS = {"left": (4, 1), "right": (4, 7)}
"""Possible places of an obstacle, by corridor."""
FLOOR, WALL, DOOR, VICTIM = (0.9, 0.9, 0.9), (0.2, 0.2, 0.2), (0.9, 0.8, 0.2), (0.1, 0.7, 0.2)
OBSTACLES = ((0.8, 0.2, 0.2), (0.6, 0.2, 0.7))
"""Colours of obstacles in the left and the right corridor."""

PORTIONS = tuple(
    f"{row}-{column}"
    for row in ("top", "middle", "bottom")
    for column in ("left", "middle", "right")
)


def as_image(portions: Tensor) -> Tensor:
    """Assemble portions ``[..., 9, 27]`` into a map ``[..., 9, 9, 3]``: rows, columns, colours."""
    blocks = portions.unflatten(-1, (PORTION, PORTION, 3)).unflatten(-4, (PORTION, PORTION))
    return blocks.transpose(-4, -3).flatten(-5, -4).flatten(-3, -2)


def as_portions(image: Tensor) -> Tensor:
    """Split a map ``[..., 9, 9, 3]`` into portions ``[..., 9, 27]``."""
    blocks = image.unflatten(-2, (PORTION, PORTION)).unflatten(-4, (PORTION, PORTION))
    return blocks.transpose(-4, -3).flatten(-5, -4).flatten(-3, -1)


def portion_pixels(holds: Tensor) -> Tensor:
    """Return pixels ``[..., 9, 27]`` given ``holds`` ``[..., 5]``: obstacles, victims in rooms."""
    empty, with_all = (portions.to(holds.device) for portions in _house())
    shown = torch.zeros(*holds.shape[:-1], len(PORTIONS), dtype=torch.bool, device=holds.device)
    shown[..., [*CORRIDOR_PORTIONS, *ROOM_PORTIONS]] = holds
    return torch.where(shown[..., None], with_all, empty)


@cache
def _house() -> tuple[Tensor, Tensor]:
    """Return empty portions ``[9, 27]``, and portions with all possible obstacles and victims."""
    image = torch.tensor([[WALL if cell == "#" else FLOOR for cell in row] for row in HOUSE])
    image[ENTRANCE] = torch.tensor(DOOR)
    full = image.clone()
    for place, colour in zip(CORRIDORS.values(), OBSTACLES, strict=True):
        full[place] = torch.tensor(colour)
    for place in ROOMS.values():
        full[place] = torch.tensor(VICTIM)
    return as_portions(image), as_portions(full)


def portion_centres() -> Tensor:
    """Return row and column of the centre of each portion, ``[9, 2]``."""
    middle = torch.arange(PORTION) * PORTION + PORTION // 2
    return torch.cartesian_prod(middle, middle)


def walkable(place: Tensor) -> Tensor:
    """Return where there is floor at rows and columns ``[..., 2]``."""
    floor = torch.tensor([[cell != "#" for cell in row] for row in HOUSE], device=place.device)
    inside = ((place >= 0) & (place < SIDE)).all(-1)
    row, column = place.clamp(0, SIDE - 1).unbind(-1)
    return inside & floor[row, column]


def at_entrance(place: Tensor) -> Tensor:
    """Return where places ``[..., 2]`` are the entrance."""
    return (place == torch.tensor(ENTRANCE, device=place.device)).all(-1)


@cache
def reach_distances() -> tuple[float, ...]:
    """Return radii in cells, one for each set of radii with equal sight from every place.

    Only distances from floor cells to informative portions matter. Each interval between
    successive distances is represented by its number with fewest decimals.
    """
    cells = torch.cartesian_prod(torch.arange(SIDE), torch.arange(SIDE))
    cells = cells[walkable(cells)]
    centres = portion_centres()[[*CORRIDOR_PORTIONS, *ROOM_PORTIONS]]
    squares = (cells[:, None] - centres).pow(2).sum(-1).unique()
    distances = [math.sqrt(int(square)) for square in squares]
    return tuple(map(_roundest, distances, [*distances[1:], math.inf]))


def _roundest(least: float, beyond: float) -> float:
    """Return the least number with fewest decimals in ``[least, beyond)``."""
    for scale in (1, 10, 100, 1000):
        number = math.ceil(least * scale - 1e-9) / scale
        if least <= number < beyond:
            return number
    return least

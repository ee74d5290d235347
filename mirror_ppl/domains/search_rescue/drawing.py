"""Pictures of states of search and rescue."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mirror_ppl.domains.search_rescue.house import as_image

LEGEND = (
    "Blue: the person. Yellow: the entrance. Green: the victim, until found. Red or purple: the "
    "obstacle. Darkened: what the person neither sees nor is shown at this step"
)
CELL, EDGE = 12, 2
"""Pixels along a side of a cell, and between the person and the cell's edges."""
PERSON = (40, 90, 200)
UNSEEN = 0.6
"""Factor on the brightness of portions that are not seen."""


def draw_house(portions: Tensor, place: Tensor, seen: Tensor | None = None) -> np.ndarray:
    """Draw ``uint8 [108, 108, 3]``: the map and the person.

    Args:
        portions: pixels ``[9, 27]``.
        place: row and column of the person, ``[2]``.
        seen: portions ``[9]`` that are not darkened; all unless given.
    """
    if seen is None:
        seen = torch.ones(len(portions), dtype=torch.bool)
    colours = as_image(torch.where(seen[:, None], portions, UNSEEN * portions)).numpy()
    picture = (255 * colours).round().astype(np.uint8).repeat(CELL, 0).repeat(CELL, 1)
    row, column = (int(part) * CELL for part in place)
    inside = slice(row + EDGE, row + CELL - EDGE), slice(column + EDGE, column + CELL - EDGE)
    picture[inside] = PERSON
    return picture

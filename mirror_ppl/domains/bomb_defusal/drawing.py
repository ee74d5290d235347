"""Pictures of states of bomb defusal."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from mirror_ppl.domains.bomb_defusal.panel import PICTURE, STAGES, TERMINALS

LEGEND = (
    "Above: terminals; the symbol of the lit one (green) and the type determine the right button. "
    "Below: stages, white if over (the press right or wrong), and the type, orange for A and blue "
    "for B"
)
CELL, GAP = 6, 6
"""Pixels along a side of a terminal's pixels, and between terminals."""
LAMP, BELOW, MARGIN = 10, 12, 4
"""Pixels of the width of a lamp of a stage, of the row of lamps, and between lamps."""
PANEL, OVER, AHEAD = (170, 170, 170), (245, 245, 245), (40, 40, 40)
"""Colours of the panel and of lamps. That of a stage that is over is neither green nor red: a state
does not hold whether the press was right."""
TYPES = ((220, 120, 40), (60, 120, 220))
"""Colours of the types A and B."""


def draw_panel(pixels: Tensor, stage: int, kind: int) -> np.ndarray:
    """Draw ``uint8 [height, width, 3]``: the terminals, the stages and the type.

    Args:
        pixels: of the terminals, ``[6, 75]``.
        stage: number of stages that are over.
        kind: 0 for Type A, 1 for Type B.
    """
    side, columns = PICTURE[0] * CELL, TERMINALS // 2
    height, width = 3 * GAP + 2 * side + BELOW, (columns + 1) * GAP + columns * side
    picture = np.full((height, width, 3), PANEL, dtype=np.uint8)
    terminals = (255 * pixels.unflatten(-1, PICTURE).numpy()).round().astype(np.uint8)
    for number, terminal in enumerate(terminals):
        row, column = divmod(number, columns)
        top, left = GAP + row * (side + GAP), GAP + column * (side + GAP)
        picture[top : top + side, left : left + side] = terminal.repeat(CELL, 0).repeat(CELL, 1)
    lamps = slice(-BELOW, -MARGIN)
    for number in range(STAGES):
        left = GAP + number * (LAMP + MARGIN)
        picture[lamps, left : left + LAMP] = OVER if number < stage else AHEAD
    picture[lamps, -GAP - 2 * LAMP : -GAP] = TYPES[kind]
    return picture

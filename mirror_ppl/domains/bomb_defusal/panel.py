"""The panel of a bomb: pictures of its terminals, and rules for the right button."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

TERMINALS = 6
STAGES = 3
KINDS = ("Type A", "Type B")
BUTTONS = ("red", "green", "blue", "yellow")
SYMBOLS: dict[str, tuple[str, ...]] = {
    "cross": ("#...#", ".#.#.", "..#..", ".#.#.", "#...#"),
    "plus": ("..#..", "..#..", "#####", "..#..", "..#.."),
    "frame": ("#####", "#...#", "#...#", "#...#", "#####"),
    "bars": ("#####", ".....", "#####", ".....", "#####"),
}
"""Symbols that a terminal may show, by rows of pixels."""
PICTURE = (5, 5, 3)
"""Rows, columns and colours of a terminal's picture."""
LIT, DIM, GROUND = (0.2, 1.0, 0.4), (0.35, 0.35, 0.35), (0.05, 0.05, 0.05)
"""Colours of the symbol on the lit terminal, on the others, and of the background."""

Rules = tuple[tuple[int, ...], ...]
"""The right button, an index into ``BUTTONS``, by kind of bomb and by symbol."""
RULES: Rules = ((0, 1, 3, 2), (3, 2, 1, 0))
"""The true rules."""
OLD_RULES: Rules = ((0, 1, 2, 3), (1, 2, 3, 0))
"""The rules that the robot was taught: wrong for two symbols of Type A, and for two of Type B."""


@cache
def pictures() -> Tensor:
    """Return pictures of dim and lit terminals, by symbol: ``[2, 4, 75]``."""
    drawn = torch.tensor([[[c == "#" for c in row] for row in s] for s in SYMBOLS.values()])
    colours = torch.tensor([DIM, LIT])[:, None, None, None]
    return torch.where(drawn[None, ..., None], colours, torch.tensor(GROUND)).flatten(2)


def panel(live: Tensor, symbols: Tensor) -> Tensor:
    """Return pixels ``[..., 6, 75]`` of terminals with symbols ``[..., 6]``; ``live`` is lit."""
    own = torch.arange(TERMINALS, device=live.device) == live[..., None]
    return pictures().to(live.device)[own.long(), symbols]


def read_panel(pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lit terminal ``[...]`` and the symbols ``[..., 6]`` nearest to pixels.

    Args:
        pixels: ``[..., 6, 75]``.
    """
    known = pictures().to(pixels)
    # Squared distances, up to a constant.
    unlike = known.pow(2).sum(-1) - 2 * (pixels @ known.flatten(0, 1).T).unflatten(-1, (2, -1))
    dim, lit = unlike.amin(-1).unbind(-1)
    live = (lit - dim).argmin(-1)
    own = torch.arange(TERMINALS, device=live.device) == live[..., None]
    best = unlike.argmin(-1)
    return live, torch.where(own, best[..., 1], best[..., 0])


def right_button(rules: Rules, kind: Tensor, symbol: Tensor) -> Tensor:
    """Return the button ``[...]`` to press."""
    return torch.tensor(rules, device=kind.device)[kind, symbol]

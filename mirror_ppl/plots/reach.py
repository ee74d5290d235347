"""Figure of the probability that a person sees items at a distance, for any world."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mirror_ppl.domains import get_domain
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.models.implants import SIGHT
from mirror_ppl.plots.picture import Picture
from mirror_ppl.plots.reading import draws, edged, explain, name_of, of_person, people, truth

if TYPE_CHECKING:
    import arviz as az

MOST_PEOPLE = 40
"""Most people on one picture."""
COLOURS = "Blues"
DARK = 0.6
"""Place on the colour scale above which numbers are white."""


def has_reach(data: az.InferenceData) -> bool:
    """True if the world is known and the posterior has thresholds of sight in each direction."""
    try:
        directions = _domain(data).directions
    except UnknownNameError:
        return False
    return bool(directions) and all(SIGHT + name in data["posterior"] for name in directions)


def reach_picture(data: az.InferenceData) -> Picture:
    """Draw a table for each direction: the probability that a person sees an item at a distance.

    A frame marks the distances that they truly see, where that is known. Of more than 40 people the
    first 40 are shown.

    Args:
        data: with sites ``sight_*``, see :func:`has_reach`.
    """
    domain, shown = _domain(data), people(data)[:MOST_PEOPLE]
    bins, directions = np.array(domain.reach_bins, np.float32), domain.directions
    size = (len(directions) * (0.55 * len(bins) + 0.4) + 1.2, 0.3 * len(shown) + 1.7)
    figure = Picture(figsize=(max(size[0], 4.5), size[1]), layout="constrained")
    grid = figure.subplots(1, len(directions), squeeze=False)
    for place, (ax, direction) in enumerate(zip(grid.flat, directions, strict=True)):
        site = SIGHT + direction
        seen = np.stack(
            [
                (draws(of_person(data, "posterior", person)[site])[:, None] >= bins).mean(0)
                for person in shown
            ]
        )
        ax.imshow(seen, cmap=COLOURS, vmin=0, vmax=1, aspect="auto")
        for (row, column), value in np.ndenumerate(seen):
            colour = "white" if value > DARK else "black"
            text = f"{value:.2f}".removeprefix("0")
            ax.text(column, row, text, ha="center", va="center", fontsize=7, color=colour)
        for row, person in enumerate(shown):
            real = truth(data, site, person)
            if real is not None:
                number = int((bins <= np.float32(real)).sum())
                ax.add_patch(_frame(row, number))
        names = [name_of(data, person) for person in shown] if place == 0 else [""] * len(shown)
        ax.set_yticks(range(len(shown)), names, fontsize=8)
        ax.set_xticks(range(len(bins)), [f"{edge:g}" for edge in bins], fontsize=8)
        ax.set_xlabel(f"distance ({domain.reach_unit})", fontsize=8)
        ax.set_title(direction.replace("_", " "), fontsize=9, loc="left")
        ax.tick_params(length=0)
        for spine in ax.spines.values():
            spine.set_visible(False)
    explain(
        figure,
        data,
        "How far each person sees",
        len(shown),
        "Probability that an item at this distance is seen.\nFramed: the true distances.",
    )
    return figure


def _frame(row: int, number: int):
    from matplotlib.patches import Rectangle

    frame = Rectangle((-0.5, row - 0.45), number, 0.9, fill=False, edgecolor="tab:red", lw=1.4)
    frame.set_path_effects(edged())
    return frame


def _domain(data: az.InferenceData):
    return get_domain(str(data["posterior"].attrs["domain"]))

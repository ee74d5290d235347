"""Figures of posterior samples of sight on the road, beside true sight (supplement, Fig. 11).

`mirror_ppl.domains.driving.road` draws probabilities of seeing a car; here each panel is one
posterior sample of the person's sight.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.patches import Rectangle

from mirror_ppl.domains.driving.knowledge import ROAD_END
from mirror_ppl.domains.driving.road import (
    HEADLIGHT,
    draw_car,
    has_sight,
    seen_of_draws,
    true_sight,
)
from mirror_ppl.plots.picture import Picture
from mirror_ppl.plots.reading import explain, label_columns, name_of, people

if TYPE_CHECKING:
    import arviz as az

__all__ = ["has_sight", "samples_picture"]

SAMPLES = 4
MOST_PEOPLE = 12
"""Maximum number of people on one picture."""
CARS = ((2, 1), (6, 0), (-3, 1), (-5, 0))
"""Cells ahead and lane of four example cars."""
RED, DARK = "#c0392b", "#000000"


def samples_picture(data: az.InferenceData) -> Picture:
    """Draw a road with four cars as each person sees it, one row each: truth and samples.

    Black is what they do not see. At most the first 12 people are shown.

    Args:
        data: with the four sites of sight, see :func:`has_sight`.
    """
    everybody = people(data)
    shown = everybody[:MOST_PEOPLE]
    real = {person: true_sight(data, person) for person in shown}
    known = any(seen is not None for seen in real.values())
    columns = ["what they see"] if known else []
    columns += [f"sample {number}" for number in range(1, SAMPLES + 1)]
    size = (3.3 * len(columns) + 0.8, 0.62 * len(shown) + 1.3)
    figure = Picture(figsize=size, layout="constrained")
    grid = figure.subplots(len(shown), len(columns), squeeze=False)
    for row, person in zip(grid, shown, strict=True):
        panels = list(row)
        if known:
            ax = panels.pop(0)
            seen = real[person]
            if seen is None:
                ax.set_axis_off()
            else:
                _draw(ax, seen)
        drawn = seen_of_draws(data, person)
        chosen = np.linspace(0, drawn.sizes["sample"] - 1, SAMPLES).round().astype(int)
        for ax, number in zip(panels, chosen, strict=True):
            _draw(ax, drawn[number])
        row[0].set_ylabel(
            name_of(data, person, "\n"), fontsize=9, rotation=0, ha="right", va="center"
        )
    label_columns(grid[0], columns)
    explain(
        figure,
        data,
        "What each person may see of the road",
        len(shown),
        "Black: not seen. Blue: the person, who drives to the right. Red: other cars.",
    )
    return figure


def _draw(ax: Axes, seen: xr.DataArray) -> None:
    """Draw a road with those of four cars that are seen, black where ``seen`` ``[2, 25]`` is 0."""
    end = ROAD_END + 0.5
    ax.add_patch(Rectangle((-end, 0), 2 * end, 2, fc=HEADLIGHT, ec="none"))
    for distance, lane in CARS:  # whole, with their arrows, or not at all
        if seen.values[lane, distance + ROAD_END]:
            draw_car(ax, distance, lane + 0.5, RED)
    draw_car(ax)
    # One artist for all cells: a hundred roads have thousands of them.
    dark = [Rectangle((cell - end, lane), 1, 1) for lane, cell in np.argwhere(seen.values == 0)]
    ax.add_collection(PatchCollection(dark, fc=DARK, ec=DARK, lw=0.4, zorder=3))
    ax.set(xlim=(-end, end), ylim=(0, 2), xticks=[], yticks=[])
    ax.set_aspect(1.4)
    for spine in ax.spines.values():
        spine.set_visible(False)

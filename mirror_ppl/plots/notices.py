"""Figure of people's probabilities to notice items, as samples (supplement, Table II)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from mirror_ppl.models.implants import NOTICES
from mirror_ppl.plots.picture import Picture, SightPicture
from mirror_ppl.plots.reading import draws, explain, name_of, of_person, people, truth

if TYPE_CHECKING:
    import arviz as az

SAMPLES = 5
MOST_PEOPLE = 12
"""Most people on one picture."""
ACROSS = 3
"""Panels in a row."""
LEAST, MOST = 0.01, 0.5
"""Probabilities beyond which colours stay the same."""
COLOURS = "YlGnBu"
DARK = 0.55
"""Place on the colour scale above which numbers are white."""


def has_notices(data: az.InferenceData) -> bool:
    """True if the posterior has probabilities of noticing items."""
    return bool(_sites(data))


def notices_picture(data: az.InferenceData) -> Picture:
    """Draw a table for each person: posterior samples, and the truth where it is known.

    Of more than 12 people the first 12 are shown.

    Args:
        data: with sites ``notices_*``, see :func:`has_notices`.
    """
    everybody, sites = people(data), _sites(data)
    shown = everybody[:MOST_PEOPLE]
    across = min(ACROSS, len(shown))
    down = -(-len(shown) // across)
    size = (across * (0.62 * len(sites) + 1.1) + 0.3, down * 2.1 + 1.3)
    figure = Picture(figsize=size, layout="constrained")
    grid = figure.subplots(down, across, squeeze=False)
    for ax in grid.flat[len(shown) :]:
        ax.set_axis_off()
    for place, (ax, person) in enumerate(zip(grid.flat, shown, strict=False)):
        posterior = of_person(data, "posterior", person)
        values = np.stack([draws(posterior[site]) for site in sites], -1)
        rows = np.linspace(0, len(values) - 1, SAMPLES).round().astype(int)
        named = {f"sample {1 + row}": values[number] for row, number in enumerate(rows)}
        real = [truth(data, site, person) for site in sites]
        if all(value is not None for value in real):
            named = {"truth": np.array(real, dtype=float), **named}
        _draw(ax, named, [site.removeprefix(NOTICES) for site in sites], place < across)
        ax.set_title(name_of(data, person), fontsize=9, loc="left")
    explain(
        figure,
        data,
        "Probability that a person notices an item at a step",
        len(shown),
        "Samples are of the posterior. Darker items are noticed sooner.",
    )
    return figure


def _sites(data: az.InferenceData) -> list[str]:
    return [str(name) for name in data["posterior"].data_vars if str(name).startswith(NOTICES)]


def _draw(ax: Axes, rows: dict[str, np.ndarray], items: list[str], first: bool) -> None:
    """Draw a table with a row of probabilities for each name; ``first`` ones name the items."""
    values = np.stack(list(rows.values()))
    scale = LogNorm(LEAST, MOST)
    ax.imshow(values.clip(LEAST, MOST), cmap=COLOURS, norm=scale, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        colour = "white" if float(scale(max(value, LEAST)) or 0.0) > DARK else "black"
        text = f"{value:.3f}".removeprefix("0")
        ax.text(column, row, text, ha="center", va="center", fontsize=7, color=colour)
    ax.set_yticks(range(len(rows)), list(rows), fontsize=7)
    names = [item.replace(" ", "\n", 1) for item in items] if first else [""] * len(items)
    ax.set_xticks(range(len(items)), names, fontsize=7)
    ax.tick_params(length=0, labeltop=True, labelbottom=False)
    if "truth" in rows:
        ax.axhline(0.5, color="black", lw=1.2)
    for spine in ax.spines.values():
        spine.set_visible(False)


NOTICES_PICTURE = SightPicture(
    has_notices, notices_picture, "how probably each person notices what is there", False
)

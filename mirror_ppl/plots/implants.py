"""Figure of a person's posteriors beside their priors, for any domain and human model."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from mirror_ppl.errors import InputError
from mirror_ppl.models.implants import ASSUMES, SIGHT
from mirror_ppl.plots.picture import Picture
from mirror_ppl.plots.reading import POSTERIOR, PRIOR, SAMPLE, TRUE, draws, of_person, truth

if TYPE_CHECKING:
    import arviz as az

TITLES = {
    "sight_front_own": "sight ahead, own lane",
    "sight_front_other": "sight ahead, other lane",
    "sight_back_own": "sight behind, own lane",
    "sight_back_other": "sight behind, other lane",
    "sight_radius": "sight, in every direction",
    "assumes_open": "assumes unknown corridors free",
    "assumes_clear": "assumes unseen cars absent",
    "assumes_closing": "assumes cars seen once come closer",
    "consistency": "consistency of choices",
    "lapse": "lapses: choices at random",
}
"""Titles of the implants of the package's own human model."""
UNITS = {"consistency": "1 / unit of reward", "lapse": "probability"}
WHOLE_ROAD = {12: "all"}
VALUES = {name: WHOLE_ROAD for name in TITLES if name.startswith(SIGHT)}
VALUES |= {name: {0: "no", 1: "yes"} for name in TITLES if name.startswith(ASSUMES)}
"""Labels of single values of implants."""
MOST_BARS = 25
"""Most distinct whole numbers that are drawn as bars; more are drawn as a density."""
GRID = 400
TAIL = 0.025
"""Share of the draws at either end that a density's range leaves out."""


def scalar_implants(data: az.InferenceData) -> list[str]:
    """Names of the implants that are one number a person, in the order of the prior."""
    names = dict.fromkeys([*data["prior"].data_vars, *data["posterior"].data_vars])
    return [
        str(name)
        for name in names
        if name in data["posterior"]
        and name in data["prior"]
        and set(data["posterior"][name].dims) == {*SAMPLE, "person"}
    ]


def plot_implants(data: az.InferenceData, person: str) -> Picture:
    """Draw the posterior of each implant that is one number beside its prior.

    Implants with few possible values are drawn as bars, others as densities. The truth is marked
    where it is known. The prior is drawn from the draws of all people, who share it.

    Args:
        data: with the groups ``posterior`` and ``prior`` (``constant_data`` for the truth).
        person: id of the person.

    Raises:
        UnknownNameError: no person has that id.
        InputError: no implant is one number.
    """
    posterior = of_person(data, "posterior", person)
    names = scalar_implants(data)
    if not names:
        raise InputError("there is nothing to draw: no implant of this human model is one number")
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    figure = Picture(figsize=(3.1 * columns, 2.5 * rows + 0.7), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    handles = {}
    for ax, name in zip(grid.flat, names, strict=False):
        after = draws(posterior[name]).astype(float)
        before = draws(data["prior"][name]).astype(float).ravel()
        true = truth(data, name, person)
        values = np.union1d(after, before)
        if len(values) <= MOST_BARS and (values == values.round()).all():
            _bars(ax, before, after, true, VALUES.get(name, {}))
        else:
            _densities(ax, before, after, true)
        ax.set_title(TITLES.get(name, name.replace("_", " ")), fontsize=11, pad=12)
        ax.set_xlabel(data["posterior"][name].attrs.get("units", UNITS.get(name, "")))
        ax.spines[["top", "right"]].set_visible(False)
        handles |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    for ax in grid.flat[len(names) :]:
        ax.set_axis_off()
    figure.suptitle(
        f"Implants of {person}: prior and posterior",
        fontsize=13,
        fontweight="bold",
    )
    order = [label for label in ("prior", "posterior", "truth") if label in handles]
    room = len(grid.flat) > len(names)
    figure.legend(
        [handles[label] for label in order],
        order,
        loc="lower right" if room else "outside lower center",
        ncols=1 if room else len(order),
        frameon=False,
        fontsize=12,
    )
    return figure


def _bars(
    ax: Axes,
    before: np.ndarray,
    after: np.ndarray,
    true: float | None,
    names: dict[int, str],
) -> None:
    """Draw probabilities of each value as bars; values are evenly spaced."""
    # The truth has a place of its own, also where no draw is equal to it.
    values = np.unique([*before, *after, *([] if true is None else [true])])
    places = np.arange(len(values))
    for label, numbers, colour, shift in (
        ("prior", before, PRIOR, -0.2),
        ("posterior", after, POSTERIOR, 0.2),
    ):
        share = (numbers[:, None] == values).mean(0)
        ax.bar(places + shift, share, 0.4, color=colour, label=label)
    ax.set_xticks(places, [names.get(int(value), f"{value:g}") for value in values])
    ax.set_ylim(0, 1.12)
    ax.set_yticks([0, 0.5, 1])
    ax.set_ylabel("probability")
    if true is not None:
        _mark(ax, float(np.searchsorted(values, true)))


def _densities(ax: Axes, before: np.ndarray, after: np.ndarray, true: float | None) -> None:
    """Draw smoothed densities, over the range of all but the outermost draws."""
    known = [] if true is None else [true]
    ends = np.concatenate([np.quantile(numbers, [TAIL, 1 - TAIL]) for numbers in (before, after)])
    low, high = min(*ends, *known), max(*ends, *known)
    margin = 0.1 * (high - low) or 0.5
    low, high = low - margin, high + margin
    # Nonnegative quantities are drawn down to 0; those that are at most 1, too, up to 1.
    bounds = []
    if min(before.min(), after.min()) >= 0:
        bounds, low = [0], max(low, 0)
        if max(before.max(), after.max()) <= 1:
            bounds, high = [0, 1], min(high, 1)
    grid = np.linspace(low, high, GRID)
    for label, numbers, colour in (("prior", before, PRIOR), ("posterior", after, POSTERIOR)):
        density = kernel_density(numbers, grid, bounds)
        ax.fill_between(grid, density, color=colour, alpha=0.45, lw=0, label=label)
        ax.plot(grid, density, color=colour, lw=1.5)
    ax.set_xlim(low, high)
    ax.set_ylim(0, ax.get_ylim()[1] * 1.12)
    ax.set_yticks([])
    ax.set_ylabel("density")
    if true is not None:
        _mark(ax, true)


def kernel_density(numbers: np.ndarray, grid: np.ndarray, bounds: Iterable[float]) -> np.ndarray:
    """Density of draws ``[S]`` at the grid's points, smoothed by Silverman's rule of thumb.

    Args:
        numbers: the draws.
        grid: points, ``[G]``.
        bounds: of the quantity; the density is reflected there.
    """
    # The bandwidth counts repeated draws once; otherwise groups of equal draws would show as peaks.
    different = len(np.unique(numbers))
    spread = min(numbers.std(), np.subtract(*np.quantile(numbers, [0.75, 0.25])) / 1.34)
    # Draws that are (nearly) all the same become a narrow peak.
    width = max(0.9 * spread * different**-0.2, (grid[-1] - grid[0]) / len(grid))
    mirrored = [numbers, *(2 * bound - numbers for bound in bounds)]
    distance = (grid[:, None] - np.concatenate(mirrored)) / width
    height = len(numbers) * width * np.sqrt(2 * np.pi)
    return np.exp(-0.5 * distance**2).sum(-1) / height


def _mark(ax: Axes, x: float) -> None:
    """Mark the truth by a line, with a triangle at its upper end."""
    top = ax.get_ylim()[1]
    ax.axvline(x, color=TRUE, lw=1.6, ls=(0, (4, 2)), zorder=3)
    ax.plot(
        [x],
        [top],
        marker="v",
        ms=10,
        ls="",
        color=TRUE,
        mec="black",
        mew=0.7,
        clip_on=False,
        label="truth",
        zorder=4,
    )

"""Figure of a comparison of human models: differences to the best one, also by person."""

from __future__ import annotations

import math
import textwrap

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from mirror_ppl.plots.picture import Picture, displayable, label_of
from mirror_ppl.plots.reading import BLACK, BLUE, GREY

WRAP = 30
"""Characters in a line of a model's name."""
LINE, GAP, PERSON, MOST = 0.24, 0.2, 0.13, 3.0
"""Inches: of a line of text, between models, from person to person, and of all people at most."""
MEASURES = {"loo": "leave-one-out", "heldout": "held-out rounds", "evidence": "log evidence"}


def plot_comparison(table: pd.DataFrame, by: str = "loo") -> Picture:
    """Draw each model's difference to the best one, over all rounds and over each person's.

    Models are rows, the best on top. Bars are one standard error to either side; a single round has
    no bar.

    Args:
        table: a row for each ``model``, the best first, over all rounds (``person`` is missing) and
            for each person, in one order: number of ``rounds``, ``log_density`` (or log evidence),
            ``difference`` to the best and its standard error ``difference_se``, NaN where there is
            none.
        by: the measure, a key of `MEASURES`.
    """
    totals = table.loc[table["person"].isna()].set_index("model")
    models = {str(model): own for model, own in table.groupby("model", sort=False)}
    best = str(totals.index[0])
    people = models[best]["person"].dropna().tolist()
    step = min(PERSON, MOST / len(people))
    below = [0.7 * LINE + step * place for place in range(len(people))]
    names = ["\n".join(textwrap.wrap(model, WRAP, break_on_hyphens=False)) for model in models]
    # Positions from the top in inches: a model's own line, and below it one line per person.
    tops, down = [], 0.0
    for model, name in zip(models, names, strict=True):
        tops.append(down)
        down += max(0 if model == best else below[-1] + step, LINE * (1 + name.count("\n"))) + GAP
    figure = Picture(figsize=(9, down + 1.9), layout="constrained")
    ax = figure.subplots()
    ax.axvline(0, color=BLACK, lw=0.8)
    ax.plot([0], [0], "s", color=BLACK, ms=8, mec="white", zorder=4)
    for model, top in list(zip(models, tops, strict=True))[1:]:
        ax.axhline(top - GAP, color=GREY, lw=0.5, alpha=0.5)
        own = models[model]
        height = np.array([top + distance for distance in below])
        _dots(ax, own.loc[own["person"].notna()], height, GREY, 4.5)
        _dots(ax, own.loc[own["person"].isna()], np.array([top]), BLUE, 8)
    ax.set_yticks(tops, [displayable(name) for name in names])
    if step == PERSON:  # else there is no room for their names
        places = [top + distance for top in tops[1:] for distance in below]
        shown = [label_of(person) for person in people] * (len(models) - 1)
        ax.set_yticks(places, shown, minor=True, fontsize=7)
    ax.set_ylim(down - GAP / 2, -GAP - LINE / 2)
    digits, name = (1, "log evidence") if by == "evidence" else (4, "log density")
    for log_density, top in zip(totals["log_density"], tops, strict=True):
        _column(ax, f"{log_density:z.{digits}f}", top)
    _column(ax, name, -GAP - LINE / 2, weight="bold")
    _finish(figure, ax, by, f"{totals.loc[best, 'rounds']} rounds of {len(people)} people")
    return figure


def _finish(figure: Picture, ax: Axes, by: str, of: str) -> None:
    """Labels, title and legend."""
    unit, error = "nats an action", "± standard error, paired"
    if by == "evidence":
        unit, error = "nats", "± Monte Carlo error of the estimate alone"
    ax.set_xlabel(f"difference to the best in {unit}; further left is worse")
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.tick_params(axis="y", which="both", length=0, pad=8)
    title = f"How much worse than the best model: {MEASURES[by]}, {of}"
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
    handles = [
        Line2D([], [], ls="", marker="s", color=BLACK, ms=8),
        Line2D([], [], ls="", marker="D", color=BLUE, ms=8),
        Line2D([], [], ls="", marker="o", color=GREY, ms=4.5),
        Line2D([], [], color=BLACK, lw=1.4),
    ]
    words = ["the best", "all rounds", "a person's rounds", error]
    figure.legend(handles, words, loc="outside lower center", ncols=4, frameon=False)


def _dots(ax: Axes, rows: pd.DataFrame, heights: np.ndarray, colour: str, size: float) -> None:
    """A dot for each row that has rounds, with a bar if it has a standard error."""
    for height, one in zip(heights.tolist(), rows.to_dict("records"), strict=True):
        if one["rounds"]:
            ax.errorbar(
                [one["difference"]],
                [height],
                xerr=None if math.isnan(one["difference_se"]) else one["difference_se"],
                fmt="D" if colour == BLUE else "o",
                color=colour,
                ms=size,
                mec="white",
                mew=0.6,
                elinewidth=size / 4,
                zorder=3,
            )


def _column(ax: Axes, text: str, y: float, weight: str = "normal") -> None:
    """A number to the right of the axes."""
    ax.annotate(
        text,
        (1, y),
        (62, 0),
        xycoords=ax.get_yaxis_transform(),
        textcoords="offset points",
        ha="right",
        va="center",
        fontweight=weight,
        annotation_clip=False,
    )

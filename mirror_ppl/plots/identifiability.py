"""Figure of the posterior entropy of perceptual implants, and of rounds' information gain."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import Patch

from mirror_ppl.plots.implants import TITLES
from mirror_ppl.plots.picture import Picture, label_of
from mirror_ppl.plots.reading import BLACK, BLUE, GREY, ORANGE, PURPLE, TITLE

if TYPE_CHECKING:
    import arviz as az

COLOURS = (BLUE, "#56B4E9", ORANGE, "#F0E442", PURPLE, "#009E73", "#D55E00", GREY)
ROW = 0.34
"""Inches of a person."""
TITLED = 3.8
"""Inches that a title takes."""
LEAST_WIDTH, CHARACTER = 4.4, 0.09
"""Inches of the left panel without ids, and of a character of an id."""
LEAST_GAIN = 0.1
"""Nats of the darkest colour, at least: lower gains are hardly worth a round."""
WRAP = 22
MOST_PEOPLE = 60


def plot_identifiability(data: az.InferenceData) -> Picture:
    """Draw posterior entropy of each person's sight, and information gain of a round per scenario.

    Left: posterior entropy of each implant of sight, stacked; hatched is the part shared with the
    policy implants. Right, if rounds were played: expected information gain of one more round.

    Args:
        data: with the group ``identifiability``; of more than 60 people the first are drawn.
    """
    everybody = len(data["identifiability"]["person"])
    group = data["identifiability"].isel(person=slice(MOST_PEOPLE))
    people = [str(person) for person in group["person"].values]
    scenarios = [str(name) for name in group["scenario"].values]
    sites = [str(name) for name in group["site"].values]
    labels = [label_of(person) for person in people]
    # Room for long ids, and for what stands below: names of scenarios, or the legend.
    least = LEAST_WIDTH + CHARACTER * max(map(len, labels))
    widths = [least, max(TITLED, 0.75 * len(scenarios))][: 1 + bool(scenarios)]
    figure = Picture(figsize=(sum(widths), ROW * len(people) + 3.4), layout="constrained")
    axes = figure.subplots(1, len(widths), width_ratios=widths, squeeze=False)[0]
    rows = np.arange(len(people))
    left = np.zeros(len(people))
    for number, site in enumerate(sites):
        whole = group["entropy"].sel(site=site).values
        shared = group["shared_with_policy"].sel(site=site).values
        colour = COLOURS[number % len(COLOURS)]
        axes[0].barh(rows, whole, 0.75, left, color=colour, lw=0)
        axes[0].barh(rows, shared, 0.75, left, color="none", hatch="//////", edgecolor=BLACK, lw=0)
        left = left + whole
    axes[0].set_yticks(rows, labels)
    axes[0].set_ylim(len(people) - 0.5, -0.5)
    axes[0].set_xlim(0, max(0.1, 1.05 * float(left.max())))
    axes[0].set_xlabel("posterior entropy of each implant, nats")
    axes[0].set_title("Posterior entropy of sight", fontsize=12)
    axes[0].spines[["top", "right"]].set_visible(False)
    handles = [
        Patch(color=COLOURS[number % len(COLOURS)], label=TITLES.get(site, site.replace("_", " ")))
        for number, site in enumerate(sites)
    ]
    handles.append(
        Patch(
            facecolor="none", hatch="//////", edgecolor=BLACK, label="shared with policy implants"
        )
    )
    if scenarios:
        _scenarios(axes[1], group["information"].values.clip(min=0), scenarios)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=2 if scenarios else 1, frameon=False
    )
    if len(people) < everybody:
        figure.suptitle(f"The first {len(people)} of {everybody} people", **TITLE)
    return figure


def _scenarios(ax, information: np.ndarray, scenarios: list[str]) -> None:
    most = max(float(information.max()), LEAST_GAIN)
    ax.imshow(information, cmap="Blues", vmin=0, vmax=most, aspect="auto")
    for row, values in enumerate(information):
        for column, value in enumerate(values):
            colour = "white" if value > 0.6 * most else BLACK
            ax.text(column, row, f"{value:.2f}", ha="center", va="center", color=colour, fontsize=8)
    names = [textwrap.fill(name, WRAP, break_on_hyphens=False) for name in scenarios]
    ax.set_xticks(range(len(names)), names, rotation=40, ha="right", fontsize=9)
    ax.set_yticks([])
    ax.set_title("Expected information gain\nof one more round (nats)", fontsize=12)
    ax.spines[:].set_visible(False)

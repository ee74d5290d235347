"""Polar figures of the posterior over sight: how far each driver sees in each direction."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.projections.polar import PolarAxes

from mirror_ppl.domains.highway.human_variants import LOG_REACH, reach_in_bins
from mirror_ppl.domains.highway.lidar import RANGE, SECTORS
from mirror_ppl.domains.highway.world import DIRECTION_OF, KNOTS, Highway
from mirror_ppl.models.implants import SIGHT
from mirror_ppl.plots.picture import Picture, SightPicture
from mirror_ppl.plots.reading import (
    BLUE,
    TRUE,
    draws,
    edged,
    explain,
    name_of,
    of_person,
    people,
    truth,
)

if TYPE_CHECKING:
    import arviz as az

SITES = tuple(SIGHT + direction for direction in Highway.directions)
MOST_PEOPLE = 12
"""Maximum number of people on one picture."""
COLUMNS = 4
LEAST_WIDTH = 5.8
"""Inches that the caption takes."""


def has_sight(data: az.InferenceData) -> bool:
    """True if the posterior has thresholds of sight, or a reach by angle."""
    posterior = data["posterior"]
    return LOG_REACH in posterior or all(site in posterior for site in SITES)


def sight_probability(data: az.InferenceData, person: str) -> np.ndarray:
    """Return the probability ``[36, 7]`` that a driver sees a car in each sector and distance.

    Args:
        data: with the sites ``sight_...`` in metres, or ``log_reach``.
        person: id of the person.

    Returns:
        Of distances between each two of ``KNOTS``: a car between 5 and 10 m is seen by all who see
        10 m.

    Raises:
        UnknownNameError: no person has that id.
    """
    own = of_person(data, "posterior", person)
    if LOG_REACH in own:
        reach = reach_in_bins(torch.from_numpy(draws(own[LOG_REACH]))).numpy()  # [S, 36]
    else:
        reach = np.stack([draws(own[site]) for site in SITES], -1)[:, list(DIRECTION_OF)]
    return (np.array(KNOTS[1:]) <= reach[..., None] + 1e-3).mean(0)


def sight_picture(data: az.InferenceData) -> Picture:
    """Draw a polar plot of each driver; darker is seen with more probability, truth is outlined.

    At most the first 12 people are shown.

    Args:
        data: as for :func:`sight_probability`.
    """
    everybody = people(data)
    shown = everybody[:MOST_PEOPLE]
    columns = min(COLUMNS, len(shown))
    rows = math.ceil(len(shown) / columns)
    width = max(2.7 * columns, LEAST_WIDTH)  # else words are cut off
    figure = Picture(figsize=(width + 0.4, 2.8 * rows + 1.6), layout="constrained")
    grid = figure.subplots(
        rows, columns, squeeze=False, subplot_kw={"projection": "polar"}
    ).flatten()
    for ax, person in zip(grid, shown, strict=False):
        _draw(ax, sight_probability(data, person))
        real = [truth(data, site, person) for site in SITES]
        if all(value is not None for value in real):
            _outline(ax, [float(value) for value in real if value is not None])
        ax.set_title(name_of(data, person), fontsize=10)
    for ax in grid[len(shown) :]:
        ax.set_axis_off()
    explain(
        figure,
        data,
        "How far each driver sees",
        len(shown),
        "Bluer: more probable that a car is seen there. Ahead is up; rings at 15, 30, 45 and\n"
        f"{RANGE:g} m, which is everything. Orange: the true reach.",
    )
    return figure


def _draw(ax: PolarAxes, probability: np.ndarray) -> None:
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    edges = (np.arange(SECTORS + 1) - 0.5) * 2 * math.pi / SECTORS
    from matplotlib.colors import LinearSegmentedColormap

    shades = LinearSegmentedColormap.from_list("seen", ["white", BLUE])
    ax.pcolormesh(edges, np.array(KNOTS), probability.T, cmap=shades, vmin=0, vmax=1)
    ax.set_ylim(0, RANGE)
    ax.set_yticks([15, 30, 45], [""] * 3)
    ax.set_xticks([], [])
    ax.grid(visible=True, axis="y", color="#bbbbbb", linewidth=0.6)


def _outline(ax: PolarAxes, reach: list[float]) -> None:
    """Draw the true reach ``[4]`` of each direction around the driver."""
    edges = (np.arange(SECTORS + 1) - 0.5) * 2 * math.pi / SECTORS
    far = [reach[direction] for direction in DIRECTION_OF]
    angles = np.repeat(edges, 2)[1:-1]
    radius = np.repeat(far, 2)
    (line,) = ax.plot(
        np.append(angles, angles[0]), np.append(radius, radius[0]), color=TRUE, lw=1.6
    )
    line.set_path_effects(edged(3.6))


PICTURES = {
    "sight.png": SightPicture(has_sight, sight_picture, "how far each driver sees, as polar plots"),
}
"""Pictures of each person's sight, by file name."""

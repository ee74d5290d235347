"""Figures of the posterior over sight, as maps of the house (supplement, Fig. 12)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from mirror_ppl.domains.search_rescue.house import PORTION, SIDE, as_image
from mirror_ppl.domains.search_rescue.moves import RescueState
from mirror_ppl.domains.search_rescue.world import SearchRescue
from mirror_ppl.models.implants import SIGHT
from mirror_ppl.plots.picture import Picture, SightPicture
from mirror_ppl.plots.reading import (
    BLUE,
    draws,
    explain,
    label_columns,
    name_of,
    of_person,
    people,
    truth,
)

if TYPE_CHECKING:
    import arviz as az

SITE = SIGHT + "radius"
MOST_PEOPLE = 12
"""Maximum number of people on one picture."""
SAMPLES = 4
PLACE = (6, 2)
"""Place of the firefighter in the pictures: in the hall by the left corridor, in a corner of a
portion that is not seen with a radius of 1."""
SCENARIO = "victim top-left, right corridor blocked"


def has_sight(data: az.InferenceData) -> bool:
    """True if the posterior has the radius that shades the house."""
    return SITE in data["posterior"]


def sight_probability(data: az.InferenceData, person: str) -> np.ndarray:
    """Return the posterior probability that a person sees each cell of the map, ``[9, 9]``.

    The firefighter stands by the left corridor and has not looked around yet.

    Args:
        data: with the site ``sight_radius``, in cells.
        person: id of the person.

    Raises:
        UnknownNameError: no person has that id.
    """
    return _seen(draws(of_person(data, "posterior", person)[SITE])).mean(0)


def sight_picture(data: az.InferenceData) -> Picture:
    """Draw the house as each person sees it, one row each: house, truth, probability, samples.

    Black is what they do not see. At most the first 12 people are shown.

    Args:
        data: as for :func:`sight_probability`.
    """
    everybody = people(data)
    shown = everybody[:MOST_PEOPLE]
    known = [truth(data, SITE, person) is not None for person in shown]
    columns = ["all there is", *(["what they see"] if any(known) else []), "probability"]
    columns += [f"sample {number}" for number in range(1, SAMPLES + 1)]
    size = (1.75 * len(columns) + 0.6, 1.8 * len(shown) + 1.65)
    figure = Picture(figsize=size, layout="constrained")
    grid = figure.subplots(len(shown), len(columns), squeeze=False)
    for row, person in zip(grid, shown, strict=True):
        panels = list(row)
        _draw(panels.pop(0), np.ones((SIDE, SIDE)), "")
        radius = truth(data, SITE, person)
        if any(known):
            ax = panels.pop(0)
            if radius is None:
                ax.set_axis_off()
            else:
                _draw(ax, _seen(np.array([radius]))[0], _cells(radius))
        _draw_probability(panels.pop(0), sight_probability(data, person))
        drawn = draws(of_person(data, "posterior", person)[SITE])
        chosen = np.linspace(0, len(drawn) - 1, SAMPLES).round().astype(int)
        for ax, value in zip(panels, drawn[chosen], strict=True):
            _draw(ax, _seen(np.array([value]))[0], _cells(value))
        row[0].set_ylabel(name_of(data, person, "\n"), fontsize=10)
    label_columns(grid[0], columns)
    explain(
        figure,
        data,
        "What each person sees of the house",
        len(shown),
        "Black: not seen. Blue: the firefighter, by the left corridor. Green: the victim.\n"
        "Purple: the obstacle. Yellow: the entrance. Below: how far they see.\n"
        "Probability that they see a cell: from black, 0, to white, 1.",
    )
    return figure


def _state() -> RescueState:
    number = SearchRescue.scenarios.index(SCENARIO)
    state = SearchRescue().initial(1, torch.Generator(), torch.tensor([number]))
    return RescueState(torch.tensor([PLACE]), state.found, state.home, state.blocked, state.victim)


def _seen(radii: np.ndarray) -> np.ndarray:
    """Return which cells of the map are seen with each radius, ``[S, 9, 9]``, 0 or 1."""
    world = SearchRescue()
    _, distance = world.distance(world.observe(_state()))
    portions = (distance[0].numpy() <= radii[:, None]).astype(float)
    each = SIDE // PORTION
    return portions.reshape(-1, each, each).repeat(PORTION, 1).repeat(PORTION, 2)


def _cells(radius: float) -> str:
    return "1 cell" if radius == 1 else f"{radius:g} cells"


def _map() -> np.ndarray:
    return as_image(SearchRescue().observe(_state())["visual"])[0].numpy()


def _draw(ax: Axes, seen: np.ndarray, label: str) -> None:
    ax.imshow(_map() * seen[..., None])
    _finish(ax)
    ax.set_xlabel(label, fontsize=8)


def _draw_probability(ax: Axes, probability: np.ndarray) -> None:
    ax.imshow(probability, cmap="gray", vmin=0, vmax=1)
    _finish(ax)
    here = probability[PLACE]
    far = probability[0, -1]
    ax.set_xlabel(f"here {here:.2f}, far corner {far:.2f}", fontsize=8)


def _finish(ax: Axes) -> None:
    row, column = PLACE
    ax.add_patch(Circle((column, row), 0.4, facecolor=BLUE, edgecolor="white", linewidth=0.8))
    for line in range(PORTION, SIDE, PORTION):
        ax.axhline(line - 0.5, color="#888888", linewidth=0.4)
        ax.axvline(line - 0.5, color="#888888", linewidth=0.4)
    ax.set(xticks=[], yticks=[])


PICTURES = {
    "sight.png": SightPicture(has_sight, sight_picture, "the house as each person sees it"),
}
"""Pictures of each person's sight, by file name."""

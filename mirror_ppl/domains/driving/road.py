"""Figures of the posterior over sight, as a road from above (supplement, Fig. 11)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerPatch
from matplotlib.lines import Line2D
from matplotlib.patches import FancyBboxPatch, Polygon, Rectangle

from mirror_ppl.domains.driving.knowledge import ROAD_END
from mirror_ppl.models.implants import SIGHT
from mirror_ppl.plots.picture import Picture
from mirror_ppl.plots.reading import (
    BLUE,
    TITLE,
    TRUE,
    draws,
    edged,
    name_of,
    of_person,
    people,
    truth,
)

if TYPE_CHECKING:
    import arviz as az

LANES = ("own", "other")
DISTANCES = np.arange(-ROAD_END, ROAD_END + 1)
"""Positions on the road in cells, negative behind the person."""
ASPHALT, STONE, HEADLIGHT = "#14181f", "#5c6066", "#fbf3d5"
DARK_TO_LIGHT = LinearSegmentedColormap.from_list("sight", (ASPHALT, STONE, HEADLIGHT))
MOST_PEOPLE = 40
"""Maximum number of people on one picture."""


def has_sight(data: az.InferenceData) -> bool:
    """True if the posterior has the four sight thresholds that shade the road."""
    return all(site in data["posterior"] for site in _sites())


def sight_probability(data: az.InferenceData, person: str) -> xr.DataArray:
    """Return the posterior probability that a person sees a car, by position of the car.

    A person with threshold r sees cars up to r cells away; a car abreast counts as ahead.

    Args:
        data: with the sites ``sight_front_own``, ``sight_front_other``, ``sight_back_own`` and
            ``sight_back_other``, in cells.
        person: id of the person.

    Returns:
        ``[2, 25]``: dimensions ``lane`` (own, other) and ``distance`` (-12 to 12 cells).

    Raises:
        UnknownNameError: no person has that id.
        KeyError: the posterior has no such sites; see :func:`has_sight`.
    """
    probability = seen_of_draws(data, person).mean("sample")
    return probability.rename("sight_probability")


def seen_of_draws(data: az.InferenceData, person: str) -> xr.DataArray:
    """Return where a person sees a car in each posterior draw, 0 or 1.

    Args:
        data: as for :func:`sight_probability`.
        person: id of the person.

    Returns:
        ``[S, 2, 25]``: dimensions ``sample``, ``lane`` and ``distance``.

    Raises:
        UnknownNameError: no person has that id.
    """
    posterior = of_person(data, "posterior", person)
    return _seen({site: draws(posterior[site]) for site in _sites()})


def true_sight(data: az.InferenceData, person: str) -> xr.DataArray | None:
    """Return a simulated person's true sight, shaped as :func:`sight_probability`, 0 or 1.

    Returns:
        ``None`` if the true values are not known.

    Raises:
        UnknownNameError: no person has that id.
    """
    reach = {site: truth(data, site, person) for site in _sites()}
    known = {site: np.array([value]) for site, value in reach.items() if value is not None}
    return _seen(known)[0] if len(known) == len(reach) else None


def plot_sight(data: az.InferenceData, person: str, ax: Axes | None = None) -> Axes:
    """Draw the road from above, light where a person sees a car and dark where they do not.

    The person's car drives to the right in the lower lane. True sight is outlined if known.

    Args:
        data: as for :func:`sight_probability`.
        person: id of the person.
        ax: where to draw; a new figure with a legend unless given.

    Returns:
        The axes; ``.figure`` is the figure.

    Raises:
        UnknownNameError: no person has that id.
    """
    probability = sight_probability(data, person)
    real = true_sight(data, person)
    if ax is None:
        figure = Picture(figsize=(10, 2.5), layout="constrained")
        ax = figure.subplots()
        _explain(figure, [ax], truth_known=real is not None)
    extent = (-ROAD_END - 0.5, ROAD_END + 0.5, 0, len(LANES))
    ax.imshow(
        probability, cmap=DARK_TO_LIGHT, vmin=0, vmax=1, origin="lower", extent=extent, zorder=0
    )
    draw_road(ax)
    if real is not None:
        for colour, width in ((ASPHALT, 4.6), (TRUE, 2.6)):
            edges = LineCollection(outline(real), colors=colour, linewidths=width, zorder=3)
            edges.set(capstyle="projecting", clip_on=False)
            ax.add_collection(edges)
    draw_car(ax)
    ax.set_aspect(1.4)
    ax.set_xticks(DISTANCES[::2], [str(abs(distance)) for distance in DISTANCES[::2]])
    ax.set_yticks([0.5, 1.5], [f"{lane} lane" for lane in LANES])
    ax.tick_params(length=0)
    ax.set_xlabel("cells behind   \N{LEFTWARDS ARROW}   |   \N{RIGHTWARDS ARROW}   cells ahead")
    ax.set_title(name_of(data, person), loc="left", fontweight="bold", fontsize=11)
    return ax


def sight_picture(data: az.InferenceData) -> Picture:
    """Draw the roads of all people (at most the first 40) on one figure, with one legend.

    Args:
        data: as for :func:`sight_probability`.
    """
    everybody = people(data)
    shown = everybody[:MOST_PEOPLE]
    # A road is about seven times as wide as it is high, with its title.
    columns = 1 if len(shown) < 4 else max(2, round(math.sqrt(len(shown) / 3)))  # noqa: PLR2004
    rows = -(-len(shown) // columns)
    # The legend below them needs some width too.
    width, height = (6.2, 0.95) if columns > 1 else (10, 1.3)
    size = (width * columns + 0.4, height * rows + 1.9)
    figure = Picture(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for ax, person in zip(grid.flat, shown, strict=False):
        plot_sight(data, person, ax)
        ax.label_outer()
    for ax in grid.flat[len(shown) :]:
        ax.set_axis_off()
        # The last road of this column is the one above.
        above = grid[rows - 2, list(grid[-1]).index(ax)]
        above.tick_params(labelbottom=True)
        above.set_xlabel(grid[-1, 0].get_xlabel())
    attributes = data["posterior"].attrs
    place = " in ".join(attributes[key] for key in ("domain", "setting") if key in attributes)
    place = f": {place}" if place else ""
    some = "" if shown == everybody else f" (the first {len(shown)} of {len(everybody)} people)"
    figure.suptitle(f"What each person sees of the road{place}{some}", **TITLE)
    truth_known = any(true_sight(data, person) is not None for person in shown)
    _explain(figure, list(grid.flat), truth_known)
    return figure


def outline(seen: xr.DataArray) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Return edges, as pairs of points, between seen and unseen cells.

    Args:
        seen: ``[2, 25]`` as from :func:`true_sight`. Cell (lane, distance) lies between
            distance - 0.5 and distance + 0.5 across, and between lane and lane + 1 upwards.
    """
    mask = np.pad(seen.values > 0, 1)
    edges: list[tuple[tuple[float, float], tuple[float, float]]] = []
    for lane, cell in np.argwhere(mask[:, 1:] != mask[:, :-1]):
        x = cell - ROAD_END - 0.5
        edges.append(((x, float(lane - 1)), (x, float(lane))))
    for lane, cell in np.argwhere(mask[1:] != mask[:-1]):
        x = cell - 1 - ROAD_END
        edges.append(((x - 0.5, float(lane)), (x + 0.5, float(lane))))
    return edges


def draw_road(ax: Axes) -> None:
    """Draw the edges, cells and lane markings of a two-lane road that runs to the right."""
    end = ROAD_END + 0.5
    ax.vlines(DISTANCES[1:] - 0.5, 0, 2, color="#9aa0a6", lw=0.5, alpha=0.45, zorder=1)
    for y in (0, 2):
        ax.plot([-end, end], [y, y], color=STONE, lw=2.5, zorder=1, solid_capstyle="butt")
    # Outlined, so that they are seen on light and dark cells alike.
    dashes = [Rectangle((x - 0.3, 0.96), 0.6, 0.08) for x in DISTANCES]
    ax.add_collection(PatchCollection(dashes, fc="white", ec=STONE, lw=0.6, zorder=2))
    ax.set_xlim(-end, end)
    ax.set_ylim(0, 2)
    for spine in ax.spines.values():
        spine.set_visible(False)


def draw_car(ax: Axes, x: float = 0.0, y: float = 0.5, colour: str = BLUE) -> None:
    """Draw a car that drives to the right, with an arrow in front and its middle at (x, y).

    It does not take part in autoscaling of the axes, which is slow.
    """
    for wheel_x in (x - 0.32, x + 0.13):
        for wheel_y in (y - 0.34, y + 0.25):
            ax.add_artist(Rectangle((wheel_x, wheel_y), 0.2, 0.09, fc=ASPHALT, zorder=4))
    body = FancyBboxPatch(
        (x - 0.4, y - 0.24),
        0.8,
        0.48,
        boxstyle="round,pad=0.04,rounding_size=0.16",
        fc=colour,
        ec="white",
        lw=0.8,
        zorder=5,
    )
    ax.add_artist(body)
    for narrow, wide in ((0.03, 0.2), (-0.2, -0.3)):
        glass = [(narrow, -0.12), (wide, -0.18), (wide, 0.18), (narrow, 0.12)]
        moved = [(x + glass_x, y + glass_y) for glass_x, glass_y in glass]
        ax.add_artist(Polygon(moved, fc="#cfe6f5", zorder=6))
    nose = [(x + 0.64, y - 0.17), (x + 0.94, y), (x + 0.64, y + 0.17)]
    ax.add_artist(Polygon(nose, fc=colour, ec="white", lw=0.8, zorder=5))


def _sites() -> tuple[str, ...]:
    return tuple(f"{SIGHT}{side}_{lane}" for side in ("front", "back") for lane in LANES)


def _seen(reach: Mapping[str, np.ndarray]) -> xr.DataArray:
    """Return where a car is seen, ``[S, 2, 25]``, for reaches ``[S]`` by site."""
    rows = []
    for lane in LANES:
        ahead, behind = (reach[f"{SIGHT}{side}_{lane}"][:, None] for side in ("front", "back"))
        rows.append(np.abs(DISTANCES) <= np.where(DISTANCES >= 0, ahead, behind))
    return xr.DataArray(
        np.stack(rows, 1).astype(float),
        dims=("sample", "lane", "distance"),
        coords={"lane": list(LANES), "distance": ("distance", DISTANCES, {"units": "cells"})},
    )


def _explain(figure: Figure, axes: list[Axes], truth_known: bool) -> None:
    """Draw a colour bar and a legend below the roads."""
    bar = figure.colorbar(
        ScalarMappable(Normalize(0, 1), DARK_TO_LIGHT),
        ax=axes,
        location="bottom",
        shrink=0.45,
        anchor=(0.0, 0.0),
        aspect=30,
        pad=0.02,
    )
    bar.set_label("posterior probability that this person sees a car there")
    bar.set_ticks([0, 0.25, 0.5, 0.75, 1], labels=["0: unseen", ".25", ".5", ".75", "1: seen"])
    handles: list[Any] = [Rectangle((0, 0), 1, 1, fc=BLUE)]
    labels = ["the person's car and its direction of travel"]
    if truth_known:
        handles.append(Line2D([], [], color=TRUE, lw=2.6, path_effects=edged(4.6, ASPHALT)))
        labels.append("outline: what they really see (simulated people)")
    figure.legend(
        handles,
        labels,
        loc="lower right",
        frameon=False,
        handler_map={Rectangle: HandlerPatch(_car_handle)},
    )


def _car_handle(legend, orig_handle, xdescent, ydescent, width, height, fontsize) -> Polygon:
    """Return a car that points to the right, for the legend."""
    left, right, nose = width * 0.15, width * 0.68, width * 0.98
    points = [(left, 0), (right, 0), (nose, height / 2), (right, height), (left, height)]
    return Polygon([(x - xdescent, y - ydescent) for x, y in points], closed=True)

"""Figures of replayed rounds of driving: the true road, and what the person knows of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import FancyBboxPatch, Polygon, Rectangle
from torch import Tensor

from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.person import Person, transitions
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains.base import Domain
from mirror_ppl.domains.driving.cars import CAR_LANES, CARS, DrivingState
from mirror_ppl.domains.driving.knowledge import ROAD_END
from mirror_ppl.domains.driving.people import Memory
from mirror_ppl.domains.driving.road import DARK_TO_LIGHT, DISTANCES, draw_car, draw_road
from mirror_ppl.errors import InputError
from mirror_ppl.models.belief_tracking import BeliefState
from mirror_ppl.plots.communication import WORDS, in_words
from mirror_ppl.plots.picture import Picture
from mirror_ppl.plots.reading import BLACK, BLUE, TRUE

# More of Okabe and Ito's colours.
VERMILLION, GREEN, YELLOW = "#D55E00", "#009E73", "#F0E442"
ROAD = "#e4e6e9"
MIDDLES = (1.5, 0.5)
"""Vertical middle of each lane: people drive to the right, so the left lane is above."""
WHOLE, LOW, APART = 0.44, 0.22, 0.23
"""Height of a car, of each of two cars in one cell, and offset of these from its middle."""


# --- what a person knows ----------------------------------------------------------------------


def share_known(person: Person, past: RoundSoFar) -> Tensor:
    """Return the share of posterior draws in which each item was seen or communicated so far.

    Args:
        person: posterior draws of the human model.
        past: a round of t actions, with the messages before each.

    Returns:
        ``[t + 1, K]``; at the last step, before the next action, there is no message yet.
    """
    nothing = {
        name: value.new_zeros(value.shape[1], dtype=torch.bool)
        for name, value in past.observation.items()
        if name in past.told
    }
    whole = past.then(nothing, 0, past.now)  # no message at the present step
    state = BeliefState.initial(person.human, person.percept_count)
    views, _ = state.perceive(transitions(person, whole))
    seen = [torch.stack(list(view.visible.values())).any(0) for view in views]
    observed = torch.stack(seen, 1).long().cummax(1).values
    return observed[person.percept].float().mean(0)


def share_seen(person: Person, lane: int) -> Tensor:
    """Return the share of posterior draws in which a car would be seen, by position.

    Args:
        person: posterior draws of the human model, of driving.
        lane: the person's lane.

    Returns:
        ``[2, 25]``: lane of the car (left, right) and distance (-12 to 12 cells).
    """
    domain = person.human.domain
    places = len(DISTANCES)
    percepts = torch.arange(person.percept_count, device=person.percept.device).repeat_interleave(
        places
    )
    rows = torch.arange(len(percepts), device=percepts.device)
    # One observation for each distance, with all cars there.
    position = torch.as_tensor(DISTANCES, device=percepts.device).repeat(person.percept_count)
    position = position[:, None].expand(-1, len(CARS))
    lanes = torch.full_like(position[..., 0], lane)
    observation = domain.observe(DrivingState(lanes, position, torch.zeros_like(position)))
    nothing = {m.name: torch.zeros_like(position, dtype=torch.bool) for m in domain.modalities}
    action = torch.zeros_like(percepts)
    transition = person.transition(percepts, action, observation, nothing, rows)
    (view,), _ = BeliefState.initial(person.human, len(percepts)).perceive([transition])
    seen = view.visible["visual"]
    share = seen.unflatten(0, (person.percept_count, places))[person.percept].float().mean(0)
    return share[:, [CAR_LANES.index(side) for side in range(len(MIDDLES))]].T


# --- rounds -----------------------------------------------------------------------------------


def plot_frames(
    person: Person,
    rounds: Mapping[str, RoundSoFar],
    steps: Sequence[int],
    knowledge: Mapping[str, Memory] | None = None,
    cells: int = ROAD_END,
) -> Picture:
    """Draw moments of rounds of driving: the true road, and below it what the person knows.

    Inferred knowledge is drawn as shares of posterior draws in which a car was seen or communicated
    so far (the number on the car), and in which a car in a cell would be seen (the shade of the
    road). The latent belief is not drawn, because its decoders are off by cells. The true knowledge
    of a simulated person is outlined.

    Args:
        person: posterior draws of the human model.
        rounds: rounds by title, one column each.
        steps: the moments, one row each: before the action of that number, counted from 0.
        knowledge: by title the true knowledge of a simulated person at each step, ``[T, K]``.
        cells: number of cells drawn ahead and behind.

    Raises:
        InputError: there are no rounds or steps, or a round does not have all of these steps.
    """
    if not rounds or not steps:
        raise InputError("there has to be a round, and a step, to draw")
    for title, past in rounds.items():
        for step in steps:
            if not 0 <= step <= past.time:
                raise InputError(f'there is no step {step} in "{title}", which has {past.time}')
    size = (0.5 + 4.75 * len(rounds), 1.85 * len(steps) + 1.6)
    figure = Picture(figsize=size, layout="constrained")
    # Roads and knowledge have equal size; around the roads there is room for messages.
    grid = figure.subplots(
        2 * len(steps), len(rounds), squeeze=False, sharex=True, height_ratios=[1.6, 1] * len(steps)
    )
    for column, (title, past) in enumerate(rounds.items()):
        known = share_known(person, past)
        memory = None if knowledge is None else knowledge.get(title)
        for row, step in enumerate(steps):
            road, mind = grid[2 * row : 2 * row + 2, column]
            _draw_road(road, past, step, cells)
            headline = _headline(person.human.domain, past, step)
            road.set_title(headline, loc="left", fontsize=10)
            _draw_mind(mind, share_seen(person, int(past.observation["ego"][step, 0])))
            places = _places(past, step, cells)
            for car, place in places.items():
                _draw_known(mind, place, float(known[step, car]), cells)
            if memory is not None and step < len(memory.known):
                _draw_thoughts(mind, memory, step, places, cells)
            draw_car(mind, 0, MIDDLES[int(past.observation["ego"][step, 0])])
        _label_column(list(grid[:, column]), title, cells, column == 0)
    _explain(figure, list(grid.flat), knowledge is not None)
    return figure


def _label_column(column: Sequence[Axes], title: str, cells: int, first: bool) -> None:
    """Set title and axes of one column: roads, and below each what the person knows."""
    for number, ax in enumerate(column):
        ax.set_xlim(-cells - 0.5, cells + 0.5)
        ax.set_yticks([])
        ax.tick_params(length=0, labelsize=8)
        if first:
            ax.set_ylabel("what they\nknow" if number % 2 else "the road", fontsize=9)
    column[0].annotate(
        title,
        (0, 1),
        (0, 24),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=12,
        fontweight="bold",
    )
    ticks = range(-cells + cells % 2, cells + 1, 2)
    column[-1].set_xticks(ticks, [str(abs(x)) for x in ticks])
    column[-1].set_xlabel(
        "cells behind   \N{LEFTWARDS ARROW}   |   \N{RIGHTWARDS ARROW}   cells ahead", fontsize=9
    )


@dataclass(frozen=True)
class _Place:
    """The middle and height of a car's block."""

    x: float
    y: float
    height: float


def _places(past: RoundSoFar, step: int, cells: int) -> dict[int, _Place]:
    """Return the places of drawn cars by number; two cars in a cell are above each other."""
    ahead = past.observation["visual"][step, :, 0].tolist()
    cell = {
        car: (x, CAR_LANES[car])
        for car, x in enumerate(ahead)
        if abs(x) < ROAD_END and abs(x) <= cells
    }
    places = {}
    for car, (x, lane) in cell.items():
        # No lane, and so no cell, has more than two cars.
        same = [other for other in cell if cell[other] == cell[car]]
        alone = len(same) == 1
        up = 0.0 if alone else APART if car == same[0] else -APART
        places[car] = _Place(x, MIDDLES[lane] + up, WHOLE if alone else LOW)
    return places


def _collided(domain: Domain, past: RoundSoFar, step: int) -> bool:
    """True if the action before this step led into a car."""
    if step == 0:
        return False
    before, after = (
        domain.state_behind({name: value[time] for name, value in past.observation.items()})
        for time in (step - 1, step)
    )
    return bool(domain.rewards(before, past.actions[step - 1], after)["collision"] < 0)


def _headline(domain: Domain, past: RoundSoFar, step: int) -> str:
    """Return the title of a moment, such as "step 3:  said rear-left, then they switch"."""
    when = f"step {step}" + (" (collision)" if _collided(domain, past, step) else "")
    if step == past.time:
        # A round that was cut at this step goes on.
        return f"{when}:  {'the end' if step == domain.horizon else 'now'}"
    channels = Channels(domain)
    flags = channels.join({name: mask[step] for name, mask in past.told.items()})
    action = domain.actions[int(past.actions[step])]
    return f"{when}:  {in_words(channels.message(flags))}, then they {action}"


def _draw_road(ax: Axes, past: RoundSoFar, step: int, cells: int) -> None:
    """Draw the true road: cars, their relative motion, and messages about them."""
    draw_road(ax)
    ax.add_patch(Rectangle((-ROAD_END - 0.5, 0), 2 * ROAD_END + 1, 2, fc=ROAD, zorder=0))
    ego = int(past.observation["ego"][step, 0])
    draw_car(ax, 0, MIDDLES[ego])
    told = {name: mask[step] for name, mask in past.told.items() if step < past.time}
    for car, place in _places(past, step, cells).items():
        x, y = place.x, place.y
        _block(ax, place, fc=VERMILLION, ec="white", lw=0.8, zorder=4)
        side = float(past.observation["verbal"][step, car, 2])
        wide = place.height / 2.2
        tip = [(x + side * out, y + up) for out, up in ((0.58, -wide), (0.94, 0), (0.58, wide))]
        ax.add_patch(Polygon(tip, fc=VERMILLION, ec="white", lw=0.8, zorder=4))
        words = [WORDS.get(name, name) for name, mask in reversed(told.items()) if mask[car]]
        if words:
            _block(ax, place, 0.1, fc="none", ec=GREEN, lw=2.4, zorder=6, gid="told")
            above = CAR_LANES[car] == 0
            ax.text(
                x,
                2.12 if above else -0.12,
                " + ".join(words),
                color=GREEN,
                fontsize=9,
                fontweight="bold",
                ha="center",
                va="bottom" if above else "top",
            )
        if x == 0 and CAR_LANES[car] == ego:
            ax.plot([x], [y], marker=(9, 1, 0), ms=21, color=YELLOW, mec=BLACK, zorder=7)
    ax.set_ylim(-0.6, 2.6)  # room for messages


def _draw_mind(ax: Axes, seen: Tensor) -> None:
    """Draw the road, shaded by where a car would be seen, ``[2, 25]``."""
    draw_road(ax)
    end = ROAD_END + 0.5
    ax.imshow(
        seen.cpu().numpy(),
        cmap=DARK_TO_LIGHT,
        vmin=0,
        vmax=1,
        extent=(-end, end, 0, 2),
        aspect="auto",
        zorder=0,
    )


def _draw_known(ax: Axes, place: _Place, share: float, cells: int) -> None:
    """Draw a car, shaded by the share of draws in which it is known, in percent."""
    _block(ax, place, fc=DARK_TO_LIGHT(share), ec="white", lw=0.8, zorder=6)
    ax.text(
        place.x,
        place.y,
        f"{100 * share:.0f}",
        color="white" if share < 0.6 else BLACK,  # noqa: PLR2004 - both are legible
        fontsize=min(9, 80 / cells) if place.height == WHOLE else 6,
        ha="center",
        va="center_baseline",
        zorder=7,
    )


def _draw_thoughts(
    ax: Axes, memory: Memory, step: int, places: Mapping[int, _Place], cells: int
) -> None:
    """Outline where a simulated person believes that the cars are."""
    known, position = memory.known[step].tolist(), memory.position[step].tolist()
    for car, (thinks, x) in enumerate(zip(known, position, strict=True)):
        if not thinks or abs(x) > cells:
            continue
        place = places.get(car)
        if place is None or place.x != x:
            place = _Place(x, MIDDLES[CAR_LANES[car]], WHOLE)
        high = 0.8 if place.height == WHOLE else 2 * APART
        corner = (place.x - 0.47, place.y - high / 2)
        ax.add_patch(
            Rectangle(corner, 0.94, high, fill=False, ec=TRUE, lw=2.2, zorder=8, gid=CARS[car])
        )


def _block(ax: Axes, place: _Place, wider: float = 0.0, **style) -> None:
    """Draw a car as a block."""
    corner = (place.x - 0.36 - wider, place.y - place.height / 2 - wider)
    size = (0.72 + 2 * wider, place.height + 2 * wider)
    shape = "round,pad=0.06,rounding_size=0.14"
    ax.add_patch(FancyBboxPatch(corner, *size, boxstyle=shape, **style))


def _explain(figure: Picture, axes: list[Axes], truth_known: bool) -> None:
    """Draw a colour bar and a legend below the frames."""
    bar = figure.colorbar(
        ScalarMappable(Normalize(0, 1), DARK_TO_LIGHT),
        ax=axes,
        location="bottom",
        shrink=0.42,
        anchor=(0.0, 0.0),
        aspect=30,
        pad=0.02,
    )
    bar.set_label(
        "share of posterior draws in which a cell is seen,\na car known (numbers: %)", size=9
    )
    bar.set_ticks([0, 0.5, 1], labels=["0", ".5", "1"])
    square = {"ls": "", "ms": 11}
    handles = [
        Line2D([], [], marker=">", color=BLUE, **square),
        Line2D([], [], marker="s", color=VERMILLION, **square),
        Line2D([], [], marker="s", mfc="none", mec=GREEN, mew=2.4, **square),
        Line2D([], [], marker="s", mfc="none", mec=TRUE, mew=2.2, **square),
    ]
    labels = [
        "the person, driving to the right",
        "other cars; arrow: motion relative to the person",
        "communicated to the person",
        "where the simulated person thinks a car is",
    ]
    number = len(handles) if truth_known else len(handles) - 1
    figure.legend(handles[:number], labels[:number], loc="lower right", frameon=False, fontsize=9)

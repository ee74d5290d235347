"""A filmstrip: the same round with and without messages, frame by frame."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from mirror_ppl.domains.base import Domain, Visibility
from mirror_ppl.domains.derived import VISUAL
from mirror_ppl.domains.world import PIXELS, offers
from mirror_ppl.errors import InputError
from mirror_ppl.plots.picture import Picture, label_of
from mirror_ppl.plots.reading import BLUE, GREY, edged

FRAMES = 6
"""Default number of frames."""
LINE = 0.14
"""Inches of a line of text below a frame."""
EDGE = 2.0
"""Points of the white edge of numbers, which are then read on any colour."""
CHARACTERS = 14
"""Characters of the legend on an inch of a picture's width."""
KNOWN = 40
"""Characters of what people know of themselves above a frame."""
WIDE = 3.0
"""Ratio of width to height from which communicators stand side by side."""


@dataclass(frozen=True)
class Strip:
    """One round of one person with one communicator.

    Attributes:
        communicator: its name.
        states: one before each decision and one after the last, without batch, T + 1.
        seen: masks ``[K]`` of the items that the person saw or was shown or told of in each state.
        messages: what was communicated at each decision, in words, T.
        actions: of the person, by name, T.
        gains: what each message was expected to gain, T; 0 for silence, or if not known.
        net: rewards less costs of the round.
        mishaps: steps with the world's mishap.
    """

    communicator: str
    states: list[Any]
    seen: list[Visibility]
    messages: list[list[str]]
    actions: list[str]
    gains: list[float]
    net: float
    mishaps: list[int]


@dataclass(frozen=True)
class Film:
    """One round, played once with each of two communicators.

    Attributes:
        domain: the world.
        person: number of the person, from 0.
        round: number of the round, from 0.
        strips: one for each of the two.
    """

    domain: Domain
    person: int
    round: int
    strips: tuple[Strip, Strip]


def plot_film(film: Film, people: Sequence[str], frames: int = FRAMES) -> Picture:
    """Draw the same round with two communicators, step by step.

    Communicators stand below each other, or side by side where pictures of the world are wide.
    Drawn are the first step at which messages or actions differ, mishaps, and steps that differ and
    at which messages were expected to gain most, then others. Below each frame stand what was
    communicated (blue) and what the person did then.

    Args:
        film: from :func:`mirror_ppl.evaluation.film.film`.
        people: ids of all people.
        frames: most frames of each communicator, at least 2.

    Raises:
        InputError: there are fewer than 2 frames.
    """
    if frames < 2:  # noqa: PLR2004 - one where rounds differ, and the last
        raise InputError(f"a film has at least 2 frames, not {frames}")
    steps = _steps(film, frames)
    height, width = np.asarray(film.domain.render(film.strips[0].states[0])).shape[:2]
    side_by_side = width > WIDE * height
    each = 5.0 if side_by_side else 2.6
    characters = 60 if side_by_side else 34
    lines = [len(_below(one, step, characters)) for one in film.strips for step in steps]
    tall = each * height / width + (0.62 if side_by_side else 1.1)
    tall += LINE * max(0, max(lines) - 3)
    shape = (len(steps), 2) if side_by_side else (2, len(steps))
    figure = Picture(figsize=(each * shape[1] + 0.3, tall * shape[0] + 0.9), layout="constrained")
    title = f"{label_of(people[film.person])}, round {film.round}"
    title += " (the first round)" if film.round == 0 else " (the first is round 0)"
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
    parts = figure.subfigures(*((1, 2) if side_by_side else (2, 1)), squeeze=False).flat
    for part, strip in zip(parts, film.strips, strict=True):
        part.suptitle(_result(strip, film), x=0.01, ha="left", fontsize=11)
        one = (len(steps), 1) if side_by_side else (1, len(steps))
        for ax, step in zip(part.subplots(*one, squeeze=False).flat, steps, strict=True):
            _frame(ax, film, strip, step, characters)
    legend = textwrap.fill(_legend(film.domain), int(CHARACTERS * figure.get_figwidth()))
    if legend:
        figure.supxlabel(legend, fontsize=9, color=GREY)
    return figure


def _legend(domain: Domain) -> str:
    """Return the world's own sentence about its pictures, or one about `World.render`."""
    if domain.picture_legend or offers(domain, "render"):
        return domain.picture_legend
    (visual,) = (modality for modality in domain.modalities if modality.name == VISUAL)
    return (
        f"Rows from above: {', '.join(visual.items)}. Columns from the left: "
        f"{', '.join(visual.features)}. Blue: above 0, orange: below, darker for larger ones. "
        "Darkened rows: what the person neither sees nor is shown at this step"
    )


def _steps(film: Film, frames: int) -> list[int]:
    """Choose steps: the last, the first that differs, mishaps, the largest gains, and others."""
    one, other = film.strips
    last = max(len(one.actions), len(other.actions))
    differ = [
        step
        for step in range(last)
        if one.messages[step : step + 1] != other.messages[step : step + 1]
        or one.actions[step : step + 1] != other.actions[step : step + 1]
    ]
    ranked = sorted(
        differ[1:],
        key=lambda step: -max(sum(strip.gains[step : step + 1]) for strip in film.strips),
    )
    hurt = sorted({step for strip in film.strips for step in strip.mishaps})
    chosen = {last}
    for step in (*differ[:1], *hurt, *ranked):
        if len(chosen) < frames:
            chosen.add(step)
    for step in np.linspace(max(min(differ, default=0) - 1, 0), last, frames):
        if len(chosen) < frames:
            chosen.add(round(step))
    return sorted(chosen)


def _result(strip: Strip, film: Film) -> str:
    what = film.domain.mishap[1]
    return f"{strip.communicator}: net return {strip.net:.2f}, {what}: {len(strip.mishaps)}"


def _frame(ax: Axes, film: Film, strip: Strip, step: int, characters: int) -> None:
    """Draw the state before a step, or the last one where the round is over by then."""
    ax.set_axis_off()
    end = len(strip.actions)
    shown = min(step, end)
    ax.imshow(film.domain.render_seen(strip.states[shown], strip.seen[shown]))
    known = "" if offers(film.domain, "render") else _numbers(ax, film.domain, strip.states[shown])
    if step >= end:
        over = f"the end, step {end}" if step == end else f"over since step {end}"
        ax.set_title(over + known, fontsize=9)
        return
    ax.set_title(f"step {step}{known}", fontsize=9)
    for number, (text, colour) in enumerate(_below(strip, step, characters)):
        ax.annotate(
            text,
            (0.5, 0),
            (0, -3 - 10 * number),
            xycoords="axes fraction",
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=8,
            color=colour,
            annotation_clip=False,
        )


def _numbers(ax: Axes, domain: Domain, state: Any) -> str:
    """Write numbers into the cells of `World.render`; returns what people know of themselves."""
    observation = domain.observe(state)
    for row, features in enumerate(observation[VISUAL].tolist()):
        for column, value in enumerate(features):
            place = ((column + 0.5) * PIXELS - 0.5, (row + 0.5) * PIXELS - 0.5)
            ax.text(
                *place,
                f"{value:.3g}",
                ha="center",
                va="center",
                fontsize=11,
                path_effects=edged(EDGE),
            )
    own = zip(domain.ego_features, observation["ego"].tolist(), strict=True)
    text = ", ".join(f"{name} {value:.3g}" for name, value in own)
    return "\n" + textwrap.shorten(text.replace("_", " "), KNOWN)


def _below(strip: Strip, step: int, characters: int) -> list[tuple[str, str]]:
    """Lines below a frame, with their colours."""
    if step >= len(strip.actions):
        return []
    message, action = ", ".join(strip.messages[step]), f"then: {strip.actions[step]}"
    return [
        (line, colour)
        for text, colour in ((message, BLUE), (action, GREY))
        for line in textwrap.wrap(text.replace("_", " "), characters)
    ]

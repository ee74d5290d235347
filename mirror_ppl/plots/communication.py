"""Figures of communication decisions: gains of messages, and predicted actions."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from torch import Tensor

from mirror_ppl.communication.decision import Decision, gain_over_silence
from mirror_ppl.communication.messages import Channels, Message
from mirror_ppl.communication.search import Found
from mirror_ppl.domains.base import require_known
from mirror_ppl.errors import InputError
from mirror_ppl.plots.picture import Picture
from mirror_ppl.plots.reading import BLACK, BLUE, GREY

PALE = "#b9bec4"
WORDS = {"visual": "shown", "verbal": "said"}
"""Verb for items of a modality; the modality's name where there is none."""
MOST = 12
"""Default number of candidates that are drawn."""
WRAP = 46
"""Characters in a line of a candidate's name."""


def plot_utilities(decision: Decision, most: int = MOST) -> Picture:
    """Draw the gains of a decision's candidates over silence, with 90% intervals.

    Silence is a square at 0. Candidates are drawn in this order of preference: silence and the
    chosen one; the two best of the others; everything at once; each item by itself; the best of the
    rest.

    Args:
        decision: with candidates to choose from.
        most: most candidates that are drawn, at least 2.

    Raises:
        InputError: the decision has no candidates to choose from, or ``most`` is below 2.
    """
    if most < 2:  # noqa: PLR2004 - silence and the chosen one
        raise InputError(f"at least 2 candidates have to be drawn, not {most}")
    found = _found(decision)
    gains = [gain_over_silence(found.valued, index) for index in range(len(found.candidates))]
    order = sorted(range(len(gains)), key=lambda index: -gains[index].mean)
    drawn = _drawn(found.candidates, decision.chosen, order, most)
    channels = Channels(decision.domain)
    names = [candidate_name(channels, found.candidates[index]) for index in drawn]
    costs = channels.cost(found.candidates[drawn]).sum(-1).tolist()
    means = [gains[index].mean for index in drawn]
    widths = np.array([np.diff(gains[index].interval)[0] / 2 for index in drawn])
    colours = [BLUE if index == decision.chosen else PALE for index in drawn]

    figure = Picture(figsize=(10, 0.36 * len(drawn) + 1.8), layout="constrained")
    ax = figure.subplots()
    place = np.arange(len(drawn))
    ax.barh(place, means, 0.66, color=colours)
    # The gain of silence over itself is 0, without uncertainty.
    spread = [row for row, index in enumerate(drawn) if index != 0]
    ax.errorbar(
        np.array(means)[spread],
        place[spread],
        xerr=widths[spread],
        fmt="none",
        ecolor=BLACK,
        elinewidth=1.4,
        capsize=3,
    )
    ax.axvline(0, color=BLACK, lw=0.8)
    silence = BLUE if decision.chosen == 0 else GREY
    ax.plot([0], [drawn.index(0)], "s", color=silence, ms=9, mec="white", clip_on=False, zorder=4)
    _name_rows(ax, names, drawn.index(decision.chosen))
    _columns(ax, means, costs)
    ax.set_xlabel("gain over silence in units of reward, cost taken off")
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.tick_params(axis="y", length=0, pad=8)
    title = f"Gains of candidate messages over silence: {len(drawn)} of {len(gains)} candidates"
    if len(drawn) < len(gains):
        title += "\n(chosen, two next best, everything, each item alone, then the best of the rest)"
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
    handles = [
        Patch(fc=BLUE),
        Patch(fc=PALE),
        Line2D([], [], ls="", marker="s", color=silence, ms=9),
        Line2D([], [], color=BLACK, lw=1.4, marker="|", ms=7),
    ]
    words = ["chosen", "not chosen", "silence", "90% interval"]
    figure.legend(handles, words, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _name_rows(ax: Axes, names: Sequence[str], chosen: int) -> None:
    """Names of candidates to the left of the axes, that of the chosen one in bold."""
    lines = ["\n".join(textwrap.wrap(name, WRAP, break_on_hyphens=False)) for name in names]
    ax.set_yticks(range(len(lines)), lines, fontsize=9)
    ax.get_yticklabels()[chosen].set(color=BLUE, fontweight="bold")
    ax.set_ylim(len(lines) - 0.4, -0.6)


def _columns(ax: Axes, means: Sequence[float], costs: Sequence[float]) -> None:
    """Gains and costs as numbers to the right of the axes, a row each."""
    rows = [
        ("gain", "cost"),
        *((f"{m:+.2f}", f"{c:.2f}") for m, c in zip(means, costs, strict=True)),
    ]
    for y, row in enumerate(rows, -1):
        for text, right in zip(row, (48, 92), strict=True):
            ax.annotate(
                text,
                (1, y),
                (right, 0),
                xycoords=ax.get_yaxis_transform(),
                textcoords="offset points",
                ha="right",
                va="center",
                fontsize=9,
                fontweight="bold" if y < 0 else "normal",
                annotation_clip=False,
            )


def _drawn(candidates: Tensor, chosen: int, order: list[int], most: int) -> list[int]:
    """Select the candidates ``[C, L, N]`` to draw, in the given order of their gains."""
    now, later = candidates[:, 0], candidates[:, 1:].flatten(1).any(1)
    everything = ((now == now.any(0)).all(1) & ~later).tolist()
    alone = ((now.sum(1) == 1) & ~later).tolist()
    others = [index for index in order if index not in (0, chosen)]
    preferred = [
        *(0, chosen),
        *others[:2],
        *(index for index in order if everything[index]),
        *(index for index in order if alone[index]),
        *others,
    ]
    kept = list(dict.fromkeys(preferred))[:most]
    return [index for index in order if index in kept]


def plot_action(decision: Decision, action: str = "switch") -> Picture:
    """Draw an action's predicted probability in steps ahead, for silence and the chosen message.

    Args:
        decision: of an objective that predicts actions.
        action: name of the action.

    Raises:
        UnknownNameError: there is no such action.
        InputError: the decision has no candidates, or the objective predicts no actions.
    """
    found, actions = _found(decision), decision.domain.actions
    number = actions.index(require_known(action, "action", actions))
    if found.valued.actions is None:
        raise InputError("the objective of this decision predicts no actions")
    probabilities = found.valued.actions / found.valued.actions.sum(-1, keepdim=True)
    name = candidate_name(Channels(decision.domain), found.candidates[decision.chosen])
    lines = [(0, "silence", GREY, "s", "--")]
    if decision.chosen != 0:
        lines.append((decision.chosen, name, BLUE, "o", "-"))
    figure = Picture(figsize=(7.5, 3.6), layout="constrained")
    ax = figure.subplots()
    steps = range(probabilities.shape[1])
    for index, label, color, marker, dashes in lines:
        predicted = probabilities[index, :, number].tolist()
        ax.plot(steps, predicted, lw=2, ms=7, label=label, color=color, marker=marker, ls=dashes)
    ax.set_ylim(-0.04, 1.04)
    ax.set_xticks(steps, ["now", *map(str, steps[1:])])
    ax.set_xlabel("steps ahead")
    ax.set_ylabel(f"predicted probability: {action}")
    ax.spines[["top", "right"]].set_visible(False)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper left", frameon=False)
    return figure


def candidate_name(channels: Channels, candidate: Tensor) -> str:
    """Describe a candidate ``[L, N]``: items communicated now, and in the steps after."""
    parts = []
    for step, flags in enumerate(candidate):
        message = channels.message(flags)
        if message:
            when = f"in {step} step{'s' * (step > 1)}: " if step else ""
            parts.append(when + in_words(message))
    return "; ".join(parts) or "silence"


def in_words(message: Message) -> str:
    """Describe a message, such as "said rear-right, shown front-left"."""
    # More informative modalities come last in domains, and first here.
    parts = [
        f"{WORDS.get(name, name)} {' + '.join(items)}"
        for name, items in reversed(list(message.items.items()))
        if items
    ]
    return ", ".join(parts) or "silence"


def _found(decision: Decision) -> Found:
    if decision.found is None:
        raise InputError("there was nothing to choose from in this decision")
    return decision.found

"""Figures of `python -m mirror_ppl.evaluate`: learning curves and relevance."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from mirror_ppl.plots.picture import Picture
from mirror_ppl.plots.reading import BLACK, BLUE, GREY, ORANGE, PURPLE, edged

PLACE = ["domain", "setting", "population"]
"""Columns that identify a place: domain, setting and population."""
Place = tuple[str, str, str]
GREEN, VERMILION, SKY = "#009E73", "#D55E00", "#56B4E9"
STYLES: dict[str, tuple[str, str, str]] = {
    "mirror": (BLUE, "-", "o"),
    "mirror-pooled": (BLUE, "-.", "*"),
    "mirror-known-sight": (BLUE, ":", "H"),
    "mirror-amortized": (SKY, "-", "s"),
    "mirror-svi": (SKY, "--", "D"),
    "mirror-nuts": (SKY, ":", "p"),
    "mirror-population": (BLUE, "--", "P"),
    "mirror-kl": (SKY, "-", "s"),
    "perceptual-only": (PURPLE, "-", "v"),
    "policy-only": (PURPLE, "--", "^"),
    "no-implants": (PURPLE, ":", "<"),
    "bc": (ORANGE, "-", "X"),
    "bc-everything": (ORANGE, ":", "x"),
    "bc-informed": (ORANGE, "-.", ">"),
    "bc-pooled": (ORANGE, "--", "8"),
    "bc-informed-pooled": (ORANGE, "--", ">"),
    "sqil": (VERMILION, "-", "d"),
    "sqil-everything": (VERMILION, ":", "x"),
    "sqil-informed": (VERMILION, "-.", ">"),
    "sqil-pooled": (VERMILION, "--", "8"),
    "logistic": (GREEN, "--", "h"),
    "base-rate": (GREEN, ":", "1"),
    "none": (GREY, ":", ""),
    "all": (GREY, "--", ""),
    "nearest": (GREY, "-.", ""),
    "oracle": (BLACK, "--", ""),
}
"""Colour, line and mark of each model."""
OTHER_LINES, OTHER_MARK = ("-", "--", "-.", ":"), "."
"""Lines and mark of users' models."""
HATCHES = {"-": "", "--": "////", ":": "....", "-.": "xxxx"}
"""Patterns of bars, by the line of the model."""
OFF_SCALE = 4.0
"""Distance from the curves, in their spans, beyond which a level is named in words."""
NO_ROUNDS = 0.4
"""Position of 0 rounds on the logarithmic scale."""
WIDTH, HEIGHT, LEGEND = 4.6, 3.8, 1.7
"""Inches: of a panel, and of the legend."""
HALO = 2.0
"""Points of the white line below that of an interval, of which a bar has to be left to see."""
ACROSS = 3
"""Panels beside each other."""
BANDS, LINES = "bands", "lines"
"""What intervals are drawn as."""
BESIDE = 1.05
"""Ratio of the places of two models with one number of rounds, so that their lines are apart."""
CHARACTERS = 14
"""Characters of a note on an inch of a picture's width."""
TOGETHER = {"all": "all modalities"}
"""Label of the modality that has the name of a model."""


class Look(NamedTuple):
    """Label and style of a model."""

    label: str
    colour: str
    line: str
    mark: str


def plot_curves(
    means: pd.DataFrame,
    label: str,
    floor: Mapping[Any, float] | None = None,
    by_ratio: bool = False,
) -> Picture:
    """Draw a measure against the number of rounds, one panel per place; bands are 90% intervals.

    The interval of a model with one number of rounds is drawn as a vertical line.

    A model that learns nothing and is so far from all others that these could not be distinguished
    is named in words.

    Args:
        means: a row for each place (``domain``, ``setting``, ``population``), ``model`` and number
            of ``rounds``, with columns ``mean``, ``low`` and ``high``; models that learn from no
            rounds at all are level lines.
        label: of the measure.
        floor: bound that cannot be surpassed, by place (a tuple of the three), where it is known.
        by_ratio: True for a logarithmic scale, which resolves values near the floor.
    """
    figure, panels = _panels(means)
    looks, marks = _looks(means["model"]), set()
    for ax, (place, here) in zip(panels, _by_place(means), strict=True):
        far, single = _far(here), 0
        for model, own in here.drop(far.index).groupby("model", sort=False):
            marks.add(_curve(ax, own.sort_values("rounds"), looks[str(model)], single))
            single += len(own) == 1 and own["rounds"].item() > 0
        for number, (model, mean) in enumerate(zip(far["model"], far["mean"], strict=True)):
            text = f"{looks[model].label}: {mean:.1f}, off the scale"
            ax.text(0.02, 0.02 + 0.06 * number, text, transform=ax.transAxes, fontsize=8)
        if floor is not None and place in floor:
            ax.axhline(floor[place], color=BLACK, lw=1, ls=":", label="people's own entropy")
        ticks = sorted({*here.loc[~_is_level(here), "rounds"]})
        ax.set_xscale("log")
        if len(ticks) == 1:
            only = max(ticks[0], NO_ROUNDS)
            ax.set_xlim(only / 2, 2 * only * BESIDE**single)
        ax.set_xticks([max(number, NO_ROUNDS) for number in ticks], [str(one) for one in ticks])
        ax.minorticks_off()
        if by_ratio:
            _logarithmic(ax)
        ax.set_xlabel("rounds learned from")
        _title(ax, place)
    _name_measure(panels, label)
    _legend(figure, panels)
    drawn = " and ".join(sorted(marks - {""}))
    if drawn:
        _note(
            figure,
            f"{drawn.capitalize()}: 90% intervals of means over people. They may overlap although "
            "one model is better in most people; tables compare person by person.",
        )
    return figure


def _by_place(table: pd.DataFrame) -> list[tuple[Place, pd.DataFrame]]:
    return [(cast(Place, place), here) for place, here in table.groupby(PLACE, sort=False)]


def _panels(table: pd.DataFrame) -> tuple[Picture, Sequence[Axes]]:
    """A figure with a panel for each place, at most ``ACROSS`` beside each other."""
    number = len(table[PLACE].drop_duplicates())
    down = math.ceil(number / ACROSS)
    across = math.ceil(number / down)
    figure = Picture(figsize=(WIDTH * across + LEGEND, HEIGHT * down), layout="constrained")
    grid = list(figure.subplots(down, across, squeeze=False).flat)
    for ax in grid[number:]:
        ax.remove()
    return figure, grid[:number]


def _name_measure(panels: Sequence[Axes], label: str) -> None:
    """Label the vertical axis of the first panel of each row."""
    for ax in panels:
        place = ax.get_subplotspec()
        if place is not None and place.is_first_col():
            ax.set_ylabel(label)


def _is_level(here: pd.DataFrame) -> np.ndarray:
    """True for rows of models that learn from no rounds."""
    return here.groupby("model")["rounds"].transform("max").to_numpy() == 0


def _far(here: pd.DataFrame) -> pd.DataFrame:
    """Levels that are farther from the curves than ``OFF_SCALE`` times their span."""
    level = _is_level(here)
    curves, levels = here.loc[~level], here.loc[level]
    low, high = curves["low"].min(), curves["high"].max()
    away = OFF_SCALE * (high - low)
    # Where there are no curves, nothing is far from them: comparisons with NaN are false.
    return levels.loc[(levels["mean"] < low - away) | (levels["mean"] > high + away)]


def _logarithmic(ax: Axes) -> None:
    """Set a logarithmic scale with plain numbers."""
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 4, 6, 8)))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter("{x:g}")


def _curve(ax: Axes, own: pd.DataFrame, look: Look, single: int) -> str:
    """Draw a model, and return what its intervals are drawn as; "" if there are none.

    Args:
        ax: the panel.
        own: rows of the model, by number of rounds.
        look: its label and style.
        single: number of models before it with one number of rounds, beside which it is drawn.
    """
    label, colour, line, mark = look
    rounds, mean = own["rounds"].to_numpy(), own["mean"].to_numpy()
    if rounds[-1] == 0:
        ax.axhline(mean[0], color=colour, ls=line, lw=1.2, label=label)
        return ""
    place, known = np.maximum(rounds, NO_ROUNDS), bool(np.isfinite(own["low"].to_numpy()).any())
    alone = len(place) == 1
    if alone:
        place = place * BESIDE**single
    ax.plot(place, mean, color=colour, ls=line, marker=mark, ms=5, label=label)
    if not known:
        return ""
    if alone:  # a band of one point would be invisible
        ax.vlines(place, own["low"], own["high"], color=colour, lw=1.2)
        return LINES
    ax.fill_between(place, own["low"], own["high"], color=colour, alpha=0.12, lw=0)
    return BANDS


def plot_relevance(shares: pd.DataFrame) -> Picture:
    """Draw the share of relevant messages after all rounds, one panel per place.

    Lines are 90% intervals. Models that learned from fewer rounds than others at that place are not
    drawn, but named below.

    Args:
        shares: columns as of `plot_curves` and ``modality``; NaN where nothing was communicated.
    """
    figure, panels = _panels(shares)
    looks, left_out = _looks(shares["model"]), []
    for ax, (place, here) in zip(panels, _by_place(shares), strict=True):
        # Rules have no rounds; what learned is shown once, after the most rounds of all.
        own = here.groupby("model")["rounds"].transform("max")
        shown = own.isin([0, here["rounds"].max()])
        last = here.loc[(here["rounds"] == own) & shown]
        where = f" in {', '.join(place)}" if len(panels) > 1 else ""
        for model, number in here.loc[~shown].groupby("model", sort=False)["rounds"].max().items():
            left_out.append(f"{looks[str(model)].label} ({number}){where}")
        models, names = (list(dict.fromkeys(last[name])) for name in ("model", "modality"))
        width = 0.8 / len(models)
        for one in last.to_dict("records"):
            x = names.index(one["modality"])
            x += (models.index(one["model"]) - (len(models) - 1) / 2) * width
            label, colour, line, _ = looks[one["model"]]
            if math.isnan(one["mean"]):
                text = f"{label}: no messages"
                ax.text(x, 1, text, rotation=90, ha="center", va="bottom", fontsize=7, color=colour)
                continue
            # The pattern distinguishes models of one colour.
            look = {"color": colour, "hatch": HATCHES[line], "edgecolor": "white", "lw": 0}
            ax.bar(x, 100 * one["mean"], 0.9 * width, label=label, **look)
            # On a white line, so that it is seen on black bars.
            interval = {"color": BLACK, "lw": 1, "path_effects": edged(HALO)}
            ax.plot([x, x], [100 * one["low"], 100 * one["high"]], **interval)
        ax.set_xticks(range(len(names)), [TOGETHER.get(str(name), str(name)) for name in names])
        ax.set_xlim(-0.5, len(names) - 0.5)
        ax.set_ylim(0, 105)
        _title(ax, place)
    _name_measure(panels, "relevant, % of the communicated items")
    _legend(figure, panels)
    known = np.isfinite(shares["low"].to_numpy()).any()
    notes = ["Lines: 90% intervals over people."] if known else []
    if left_out:
        notes.append(f"Not drawn, as they learned from fewer rounds: {'; '.join(left_out)}.")
    if notes:
        _note(figure, " ".join(notes))
    return figure


def _note(figure: Figure, text: str) -> None:
    """Write what marks mean below all panels, beside a legend that may be long."""
    width = int(CHARACTERS * (figure.get_figwidth() - LEGEND))
    lines = textwrap.fill(text, width, break_on_hyphens=False)
    figure.supxlabel(lines, x=0.01, ha="left", fontsize=9)


def _title(ax: Axes, place: Place) -> None:
    ax.set_title(", ".join(place), fontsize=10)
    ax.spines[["top", "right"]].set_visible(False)


def _looks(models: Iterable[str]) -> dict[str, Look]:
    """Label and style of each model; users' ones are labelled by file and class if unambiguous."""
    names = list(dict.fromkeys(models))
    own = [name for name in names if name not in STYLES]
    short = [name.rsplit("/", 1)[-1] for name in own]
    looks = {name: Look(name, *style) for name, style in STYLES.items()}
    for place, (name, last) in enumerate(zip(own, short, strict=True)):
        label = last if short.count(last) == 1 else name
        looks[name] = Look(label, GREY, OTHER_LINES[place % len(OTHER_LINES)], OTHER_MARK)
    return looks


def _legend(figure: Figure, panels: Sequence[Axes]) -> None:
    """Draw one legend for all panels, models in the order of `STYLES`."""
    entries = {}
    for ax in panels:
        for handle, name in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(name, handle)
    order = [name for name in STYLES if name in entries]
    order += [name for name in entries if name not in STYLES]
    handles = [entries[name] for name in order]
    figure.legend(handles, order, loc="outside right upper", frameon=False, fontsize=9)

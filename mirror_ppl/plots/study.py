"""Learning curves, and what was told: the figures of `python -m mirror_ppl.evaluate`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from mirror_ppl.evaluation.study_summary import Place, Share, Standing
from mirror_ppl.plots.picture import Picture
from mirror_ppl.plots.reading import BLACK, BLUE, GREY, ORANGE, PURPLE

GREEN, VERMILION, SKY = "#009E73", "#D55E00", "#56B4E9"
STYLES: dict[str, tuple[str, str, str]] = {
    "mirror": (BLUE, "-", "o"),
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
    "sqil": (VERMILION, "-", "d"),
    "sqil-everything": (VERMILION, ":", "x"),
    "logistic": (GREEN, "-", "h"),
    "none": (GREY, ":", ""),
    "all": (GREY, "--", ""),
    "oracle": (BLACK, "--", ""),
}
"""Colour, line and mark of each model."""
OTHER_LINES, OTHER_MARK = ("-", "--", "-.", ":"), "."
"""Of models of one's own."""
OFF_SCALE = 4.0
"""Spans of the curves beyond which a level is told in words."""
WIDTH, HEIGHT, LEGEND = 4.6, 3.8, 1.7
"""Inches: of a panel, and of the legend."""


class Look(NamedTuple):
    """How a model is called and drawn."""

    label: str
    colour: str
    line: str
    mark: str


def plot_curves(
    standings: Sequence[Standing],
    label: str,
    floor: Mapping[Place, float] | None = None,
    by_ratio: bool = False,
) -> Picture:
    """Draw a measure against the number of rounds, one panel a place; bands are 90% intervals.

    Who learns nothing and does so much better or worse that all others would look alike is told in
    words.

    Args:
        standings: of `summarize_study`; models that learn from 0 rounds are level lines.
        label: what is measured.
        floor: what cannot be surpassed, by place, if it is known.
        by_ratio: the measure is shown by its logarithm, so that what is near the floor can be told
            apart beside what is far from it.
    """
    places = list(dict.fromkeys(one.place for one in standings))
    figure = Picture(figsize=(WIDTH * len(places) + LEGEND, HEIGHT), layout="constrained")
    panels = figure.subplots(1, len(places), squeeze=False)[0]
    looks = _looks(one.model for one in standings)
    for ax, place in zip(panels, places, strict=True):
        here = [one for one in standings if one.place == place]
        far = _far([one for one in here if one.rounds == 0], [one for one in here if one.rounds])
        for model in dict.fromkeys(one.model for one in here if one not in far):
            own = [one for one in here if one.model == model]
            _curve(ax, sorted(own, key=lambda one: one.rounds), looks[model])
        for number, one in enumerate(far):
            text = f"{looks[one.model].label}: {one.measured.mean:.1f}, off the scale"
            ax.text(0.02, 0.02 + 0.06 * number, text, transform=ax.transAxes, fontsize=8)
        if floor is not None and place in floor:
            ax.axhline(floor[place], color=BLACK, lw=1, ls=":", label="people's own entropy")
        ticks = sorted({one.rounds for one in here} - {0})
        ax.set_xscale("log")
        ax.set_xticks(ticks, [str(number) for number in ticks])
        ax.minorticks_off()
        if by_ratio:
            _logarithmic(ax)
        ax.set_xlabel("rounds learned from")
        _title(ax, place)
    panels[0].set_ylabel(label)
    _legend(figure, panels)
    return figure


def _far(level: Sequence[Standing], curves: Sequence[Standing]) -> list[Standing]:
    """Which levels are farther from the curves than ``OFF_SCALE`` times their span."""
    if not curves:
        return []
    low, high = min(one.measured.low for one in curves), max(one.measured.high for one in curves)
    away = OFF_SCALE * (high - low)
    return [one for one in level if not low - away <= one.measured.mean <= high + away]


def _logarithmic(ax: Axes) -> None:
    """Show heights by their logarithm, with numbers that are read as such."""
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 4, 6, 8)))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter("{x:g}")


def _curve(ax: Axes, own: Sequence[Standing], look: Look) -> None:
    label, colour, line, mark = look
    if own[-1].rounds == 0:
        ax.axhline(own[0].measured.mean, color=colour, ls=line, lw=1.2, label=label)
        return
    rounds = [one.rounds for one in own]
    mean = [one.measured.mean for one in own]
    ax.plot(rounds, mean, color=colour, ls=line, marker=mark, ms=5, label=label)
    low, high = [one.measured.low for one in own], [one.measured.high for one in own]
    ax.fill_between(rounds, low, high, color=colour, alpha=0.12, lw=0)


def plot_relevance(places: Sequence[Sequence[Share]]) -> Picture:
    """Draw which share of what was told was relevant, one panel a place, after all rounds.

    Args:
        places: of each what `relevance` found.
    """
    figure = Picture(figsize=(WIDTH * len(places) + LEGEND, HEIGHT), layout="constrained")
    panels = figure.subplots(1, len(places), squeeze=False)[0]
    looks = _looks(one.model for shares in places for one in shares)
    for ax, shares in zip(panels, places, strict=True):
        most = max(one.rounds for one in shares)
        last = [one for one in shares if one.rounds in (0, most)]
        models = list(dict.fromkeys(one.model for one in last))
        names = list(dict.fromkeys(one.modality for one in last))
        width = 0.8 / len(models)
        for one in last:
            x = names.index(one.modality)
            x += (models.index(one.model) - (len(models) - 1) / 2) * width
            label, colour = looks[one.model][:2]
            if one.share is None:
                text = f"{label}: nothing told"
                ax.text(x, 1, text, rotation=90, ha="center", va="bottom", fontsize=7, color=colour)
                continue
            ax.bar(x, 100 * one.share.mean, 0.9 * width, color=colour, label=label)
            ax.plot([x, x], [100 * one.share.low, 100 * one.share.high], color=BLACK, lw=1)
        ax.set_xticks(range(len(names)), names)
        ax.set_ylim(0, 105)
        _title(ax, shares[0].place)
    panels[0].set_ylabel("relevant, % of the items told")
    _legend(figure, panels)
    return figure


def _title(ax: Axes, place: Place) -> None:
    ax.set_title(" ".join(place).replace("_", " "), fontsize=10)
    ax.spines[["top", "right"]].set_visible(False)


def _looks(models: Iterable[str]) -> dict[str, Look]:
    """How each model looks; those of one's own are called by file and class if that is enough."""
    names = list(dict.fromkeys(models))
    own = [name for name in names if name not in STYLES]
    short = [name.rsplit("/", 1)[-1] for name in own]
    looks = {name: Look(name, *style) for name, style in STYLES.items()}
    for place, (name, last) in enumerate(zip(own, short, strict=True)):
        label = last if short.count(last) == 1 else name
        looks[name] = Look(label, GREY, OTHER_LINES[place % len(OTHER_LINES)], OTHER_MARK)
    return looks


def _legend(figure: Figure, panels: Sequence[Axes]) -> None:
    """One for all panels, each name once, models in the order of `STYLES`."""
    entries = {}
    for ax in panels:
        for handle, name in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(name, handle)
    order = [name for name in STYLES if name in entries]
    order += [name for name in entries if name not in STYLES]
    handles = [entries[name] for name in order]
    figure.legend(handles, order, loc="outside right upper", frameon=False, fontsize=9)

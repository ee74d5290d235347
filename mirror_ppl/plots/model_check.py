"""Figure of the model check of each person."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from mirror_ppl.inference.results.checks import ONE_SIDED, REPLICATES, SHARE, tail
from mirror_ppl.inference.results.criticism import FINE, LEVEL, SUSPECT, UNEXPLAINED
from mirror_ppl.plots.picture import Picture, label_of
from mirror_ppl.plots.reading import BLACK, BLUE, ORANGE, TITLE

if TYPE_CHECKING:
    import arviz as az
    import xarray as xr

ROW, COLUMN = 0.34, 0.62
"""Inches of a person and of a check."""
LIKELIHOODS = 3.6
"""Inches of the panel of likelihoods."""
MODEL = BLUE, "o", 7, "the model"
BASE_RATE = BLACK, "|", 14, "base rate of each action"
NO_IMPLANTS = ORANGE, "D", 7, "no implants"
"""Colour, marker, its size and the name of each prediction."""
HELD_OUT = {"nll_no_implants": NO_IMPLANTS, "nll": MODEL, "nll_base_rate": BASE_RATE}
LEFT_OUT = {"nll_left_out": MODEL, "nll_left_out_base_rate": BASE_RATE}
LEAST_WIDTH, CHARACTER = 1.4, 0.09
"""Inches of the left panel without ids, and of a character of an id."""
WRAP, DARK = 12, 2.3
"""Characters in a line of a name, and the depth of a colour above which letters are white."""
MOST_PEOPLE = 60
NAMES = {
    "delayed": "fits the step before",
    "switches": "action changes",
    "reward": "reward at once",
    "surprise": "surprise of actions",
    "missed": "misses things",
    "forgot": "forgets things",
}
"""What the columns of checks are called."""


def plot_model_check(data: az.InferenceData) -> Picture:
    """Draw each person's posterior predictive checks and likelihoods of actions.

    Left: p-values, two-sided but for those of perception, with an arrow up (blue) where there is
    more than the model predicts and down (red) where there is less; frames mark those that make a
    person suspect. Right, NLL in nats an action of held-out rounds: of the model, of the base rate
    of each action, and of the model without implants. If none were held out, those of training
    rounds, each predicted from the others: of the model and of the base rate.

    Args:
        data: with the group ``model_check``. Of more than 60 people 60 are drawn: those who are
            unexplained, then those who are suspect, then the first of the others.
    """
    everybody = data["model_check"]
    group = everybody.isel(person=_drawn(list(everybody["verdict"].values)))
    labels = [label_of(str(person)) for person in group["person"].values]
    labels = [
        label if verdict in FINE else f"{label} ({verdict})"
        for label, verdict in zip(labels, group["verdict"].values, strict=True)
    ]
    shown = _shown(group)
    checks = len(group["check"])
    least = LEAST_WIDTH + COLUMN * max(checks, 3) + CHARACTER * max(map(len, labels))
    widths = [least, LIKELIHOODS][: 1 + bool(shown)]
    figure = Picture(figsize=(sum(widths), ROW * len(labels) + 2.4), layout="constrained")
    axes = figure.subplots(1, len(widths), width_ratios=widths, squeeze=False)[0]
    _p_values(axes[0], group)
    axes[0].set_yticks(range(len(labels)), labels)
    if shown:
        _likelihoods(axes[1], group, shown)
    for ax in axes:
        ax.set_ylim(len(labels) - 0.5, -0.5)
        ax.spines[:].set_visible(False)
    if len(labels) < len(everybody["person"]):
        some = f"{len(labels)} of {len(everybody['person'])} people"
        figure.suptitle(f"{some}: unexplained, then suspect ones first", **TITLE)
    return figure


def _drawn(verdicts: list[str]) -> list[int]:
    """Places of the people to draw, in order; where all fit, in that of the recordings."""
    places = list(range(len(verdicts)))
    if len(places) > MOST_PEOPLE:
        rank = {UNEXPLAINED: 0, SUSPECT: 1}
        places.sort(key=lambda place: rank.get(verdicts[place], len(rank)))
    return places[:MOST_PEOPLE]


def _p_values(ax, group: xr.Dataset) -> None:
    values = group["p_value"].values
    checks = [str(name) for name in group["check"].values]
    tails = np.array([[tail(*pair) for pair in zip(checks, own, strict=True)] for own in values])
    # As powers of ten, with the sign of the deviation.
    depth = -np.log10(tails.clip(1 / REPLICATES, 1))
    single = np.array([name in ONE_SIDED for name in checks])
    more = single | (values < 0.5)  # noqa: PLR2004 - the middle of p-values
    ax.imshow(
        np.where(more, depth, -depth),
        cmap="RdBu",
        vmin=-4,
        vmax=4,
        aspect="auto",
    )
    limit = LEVEL / np.maximum(np.isfinite(values).sum(1), 1)
    for row, own in enumerate(tails):
        for column, value in enumerate(own):
            if not np.isfinite(value):
                continue
            text = f"{value:.2f}" if value >= 0.01 else f"{value:.3f}"  # noqa: PLR2004
            text = f"<{2 / REPLICATES:.3f}" if value < 2 / REPLICATES else text
            if not single[column]:  # grey prints do not tell the colours apart
                arrow = "\N{UPWARDS ARROW}" if more[row, column] else "\N{DOWNWARDS ARROW}"
                text = arrow + text
            colour = "white" if depth[row, column] > DARK else BLACK
            frame = {"edgecolor": colour, "facecolor": "none", "pad": 1.5, "lw": 1}
            ax.text(
                column,
                row,
                text.replace("0.", "."),
                ha="center",
                va="center",
                color=colour,
                fontsize=8,
                bbox=frame if value < limit[row] else None,
            )
    shares = [place for place, name in enumerate(checks) if name.startswith(SHARE)]
    several = len(shares) > 1
    names = [NAMES.get(name, name) for name in checks]
    _name_columns(ax, [name.removeprefix(SHARE) if several else name for name in names])
    named = [NAMES.get(name, name) for name in checks if name in ONE_SIDED]
    sided = f" (one-sided: {', '.join(named)})" if named else ""
    title = (
        f"Two-sided p-values{sided};\n"
        "\N{UPWARDS ARROW} more, \N{DOWNWARDS ARROW} less than predicted; "
        f"framed (suspect): below {LEVEL} / their number"
    )
    ax.set_title(title, fontsize=11, pad=22 if several else None)
    if several:
        _name_group(ax, shares[0], shares[-1], "share of each action")


def _name_columns(ax, names: list[str]) -> None:
    """Write names below columns, upright if they are too long to be read at an angle."""
    wrapped = [textwrap.fill(name, WRAP) for name in names]
    if max(name.count("\n") for name in wrapped):
        ax.set_xticks(range(len(names)), names, rotation=90, fontsize=9)
    else:
        ax.set_xticks(range(len(names)), wrapped, rotation=40, ha="right", fontsize=9)


def _name_group(ax, first: int, last: int, name: str) -> None:
    """Draw a line above some columns, with a name over it."""
    above = ax.get_xaxis_transform()  # x of the data, y of the panel
    ax.plot(
        [first - 0.42, last + 0.42], [1.02, 1.02], color=BLACK, lw=1, transform=above, clip_on=False
    )
    ax.annotate(
        name,
        ((first + last) / 2, 1.02),
        (0, 3),
        xycoords=above,
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=9,
    )


def _shown(group: xr.Dataset) -> dict[str, tuple[str, str, int, str]]:
    """Likelihoods that are drawn, with their looks; none if there are none."""
    for looks in (HELD_OUT, LEFT_OUT):
        if all(name in group for name in looks) and np.isfinite(group[[*looks][-1]].values).any():
            return looks
    return {}


def _likelihoods(ax, group: xr.Dataset, looks: dict[str, tuple[str, str, int, str]]) -> None:
    rows = np.arange(len(group["person"]))
    for name, (colour, marker, size, label) in looks.items():
        ax.plot(group[name].values, rows, marker, color=colour, label=label, mew=2, ms=size)
    ax.set_xlim(0, 1.08 * float(np.nanmax([group[name].values for name in looks])))
    ax.set_yticks([])
    ax.set_xlabel("nats an action; less is better")
    what = "Held-out actions" if looks is HELD_OUT else "Left-out rounds"
    ax.set_title(what, fontsize=11)
    ax.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1, 0.5))

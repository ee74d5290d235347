"""Figures of simulation-based calibration: ranks and coverage."""

from __future__ import annotations

from collections.abc import Iterator
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from scipy.stats import binom

from mirror_ppl.inference.calibration.ranks import LEVELS, Calibration
from mirror_ppl.inference.calibration.uniformity import ecdf_band, rank_edges
from mirror_ppl.plots.implants import TITLES
from mirror_ppl.plots.picture import Picture
from mirror_ppl.plots.reading import BLACK, BLUE, ORANGE, PURPLE

BARS = 0.999
"""Share of the bars of calibrated posteriors that end inside of the band."""
ERRORS = 2
"""Standard errors that bars of coverage show on either side."""
RIGHT, REJECTED, BAND = BLUE, ORANGE, "#d4d4d4"
EDGE = "#555555"
LEVEL_STYLES = tuple(zip(LEVELS, (PURPLE, ORANGE, BLUE), ("s", "^", "o"), strict=True))
LETTERS = 24
"""Most characters of a site's name in one line."""
COLUMNS = 4


def plot_ranks(calibration: Calibration) -> Picture:
    """Draw histograms of the truth's rank among the draws: rows are sites, columns rounds.

    Calibrated posteriors give a flat histogram, 99.9% of whose bars end inside of the grey band.
    Too narrow ones give a histogram that is high at both ends, too wide ones a hill, and shifted
    ones a slope. The bars are those of
    :func:`mirror_ppl.inference.calibration.uniformity.histogram_p_value`, relative to their
    expectation.
    """
    edges = rank_edges(calibration.people, calibration.draws)
    expected = calibration.people * np.diff(edges) / edges[-1]
    tails = np.array([[1 - BARS], [1 + BARS]]) / 2
    low, high = binom.ppf(tails, calibration.people, expected / calibration.people) / expected
    figure = Picture(figsize=_size(calibration), layout="constrained")
    for ax, ranks, colour in _panels(figure, calibration):
        counts, _ = np.histogram(ranks, edges)
        ax.stairs(high, edges, baseline=low, fill=True, color=BAND, zorder=0)
        ax.bar(
            edges[:-1],
            counts / expected,
            np.diff(edges),
            align="edge",
            color=colour,
            ec="white",
            lw=0.5,
            alpha=0.75,
        )
        for end in (low, high):  # again, where bars hide the band
            ax.stairs(end, edges, baseline=None, color=EDGE, lw=0.8)
        ax.axhline(1, color=BLACK, lw=1, ls=":")
        ax.set_xlim(0, edges[-1])
        ax.set_xticks([0, edges[-1] / 2, edges[-1]], ["0", "", str(calibration.draws)])
    _title(
        figure,
        "Are ranks of the truth uniform?",
        f"grey: where {BARS:.1%} of the bars of calibrated posteriors end; orange: rejected",
    )
    figure.supxlabel("rank of the truth among the draws", fontsize=11)
    figure.supylabel("people, relative to expected", fontsize=11)
    return figure


def plot_ecdf(calibration: Calibration) -> Picture:
    """Draw the empirical distribution function of ranks, minus a uniform one's: rows are sites.

    For calibrated posteriors the whole line stays inside of the grey band, except for half of the
    failure rate; the other half is for histograms. Lines that stay above 0 indicate posteriors that
    are too high, lines that rise and then fall below 0 too narrow ones.
    """
    # Each of the two tests fails half as often, where there are people enough for both.
    both = np.isfinite(calibration.table()["p_histogram"].to_numpy()).all()
    rate = calibration.failure_rate / (2 if both else 1)
    expected, low, high = ecdf_band(calibration.people, calibration.draws, rate)
    edges = np.rint(expected * (calibration.draws + 1))
    figure = Picture(figsize=_size(calibration), layout="constrained")
    for ax, ranks, colour in _panels(figure, calibration):
        below = (ranks[:, None] < edges).mean(0)
        ax.fill_between(expected, low - expected, high - expected, color=BAND, lw=0, zorder=0)
        ax.plot(expected, below - expected, color=colour, lw=1.8)
        ax.axhline(0, color=BLACK, lw=1, ls=":")
        ax.set_xlim(0, 1)
        ax.set_xticks([0, 0.5, 1], ["0", ".5", "1"])
    _title(
        figure,
        "Are ranks of the truth uniform?",
        f"grey: holds {100 * (1 - rate):g}% of calibrated posteriors' lines; orange: rejected",
    )
    figure.supxlabel("rank of the truth among the draws, as a share", fontsize=11)
    figure.supylabel("share below, minus expected", fontsize=11)
    return figure


def plot_coverage(calibration: Calibration) -> Picture:
    """Draw the coverage of central intervals against the number of rounds, one panel per site.

    Bars are two binomial standard errors to either side, within 0 and 1; dotted lines show the
    nominal coverage.
    """
    coverage, error = calibration.coverage, calibration.coverage_error
    sites = coverage["site"].values.tolist()
    columns = min(COLUMNS, len(sites))
    rows = -(-len(sites) // columns)
    width = max(2.8 * columns + 0.6, 5.5)
    figure = Picture(figsize=(width, 2.4 * rows + 1.4), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    place = np.arange(coverage.sizes["rounds"])
    lowest = float((coverage - ERRORS * error).min()) - 0.05
    handles = {}
    for ax, site in zip(grid.flat, sites, strict=False):
        for level, colour, marker in LEVEL_STYLES:
            ax.axhline(level, color=colour, lw=1.2, ls=":")
            held = coverage.sel(site=site, level=level).values
            bars = ERRORS * error.sel(site=site, level=level).values
            handles[f"{level:.0%} interval"] = ax.errorbar(
                # Side by side, so that bars of neighbouring levels can be distinguished.
                place + 0.08 * (LEVELS.index(level) - 1),
                held,
                np.minimum(bars, [held, 1 - held]),
                color=colour,
                marker=marker,
                ms=6,
                lw=1.5,
                capsize=3,
            )
        ax.set_title(fill(_name(site), 28), fontsize=11)
        ax.set_xticks(place, [f"{rounds}" for rounds in coverage["rounds"].values])
        ax.set_xlim(-0.4, len(place) - 0.6)
        ax.set_ylim(max(0.0, min(lowest, 0.4)), 1.02)
        ax.set_yticks(LEVELS, [f"{level:.0%}" for level in LEVELS])
        ax.set_xlabel("rounds inferred from")
        ax.spines[["top", "right"]].set_visible(False)
    for ax in grid.flat[len(sites) :]:
        ax.set_axis_off()
    _title(
        figure,
        "How often do intervals hold the truth?",
        f"{calibration.people} people; bars: two standard errors; dotted: nominal coverage",
    )
    figure.supylabel("share of people", fontsize=11)
    figure.legend(
        list(handles.values()),
        list(handles),
        loc="outside lower center",
        ncols=len(handles),
        frameon=False,
    )
    return figure


def _panels(figure: Picture, calibration: Calibration) -> Iterator[tuple[Axes, np.ndarray, str]]:
    """Axes of each site (rows) and number of rounds (columns), ranks ``[P]``, and a colour."""
    sites, rounds = (calibration.data[name].values.tolist() for name in ("site", "rounds"))
    rejected = calibration.rejected
    grid = figure.subplots(
        len(sites),
        len(rounds),
        squeeze=False,
        sharex=True,
        sharey=True,
        gridspec_kw={"wspace": 0.1},  # so that the last tick is not read with the next first
    )
    for row, site in zip(grid, sites, strict=True):
        row[0].set_ylabel(
            fill(_name(site), LETTERS),
            rotation=0,
            ha="right",
            va="center",
            fontsize=11,
        )
        for ax, number in zip(row, rounds, strict=True):
            if site == sites[0]:
                ax.set_title(f"{number} round{'s' * (number > 1)}", fontsize=11)
            ax.spines[["top", "right"]].set_visible(False)
            wrong = (site, number) in rejected
            ranks = calibration.data["rank"].sel(site=site, rounds=number).values
            yield ax, ranks, REJECTED if wrong else RIGHT


def _size(calibration: Calibration) -> tuple[float, float]:
    """Width and height in inches of a grid of panels."""
    sizes = calibration.data.sizes
    return max(2.5 * sizes["rounds"] + 2.2, 7.5), max(1.25 * sizes["site"] + 1.5, 3.2)


def _name(site: str) -> str:
    return TITLES.get(site, site.replace("_", " "))


def _title(figure: Picture, question: str, explanation: str) -> None:
    figure.suptitle(f"{question}\n{explanation}", fontsize=12)

"""Pictures of calibrations: what they show is checked in numbers, and that each draws."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_hex
from scipy.stats import binom
from test_ranks import RARELY, gaussian, judged

from mirror_ppl.inference.calibration.ranks import LEVELS, collect, join_rounds
from mirror_ppl.inference.calibration.uniformity import ecdf_band, rank_edges
from mirror_ppl.plots.calibration import plot_coverage, plot_ecdf, plot_ranks
from mirror_ppl.plots.reading import BLUE, ORANGE

ODD = r"$\no$"
"""A name that is no formula."""


@pytest.fixture
def half_wrong(rng):
    """Right posteriors but for the second site after nine rounds."""
    parts = {number: judged(rng, 400, sites=(ODD, "y")) for number in (1, 9)}
    narrow = judged(rng, 400, width=0.5, sites=("y",))
    for name in ("rank", "place"):
        parts[9][name][1] = narrow[name][0]
    prior = {site: rng.normal(size=4000) for site in (ODD, "y")}
    return replace(collect([join_rounds(parts)], prior, (), {}), failure_rate=RARELY)


def grids(figure, number):
    axes = [ax for ax in figure.axes if ax.axison]
    assert len(axes) == number
    figure._repr_png_()  # draws everything
    return axes


def colours(axes, part):
    return [to_hex(part(ax), keep_alpha=False).upper() for ax in axes]


def test_pictures_of_ranks_show_the_numbers(half_wrong):
    assert half_wrong.rejected == [("y", 9)]
    axes = grids(plot_ranks(half_wrong), 4)
    edges = rank_edges(400, 100)
    expected = 400 * np.diff(edges) / 101
    for ax, (site, rounds) in zip(axes, itertools.product((ODD, "y"), (1, 9)), strict=True):
        own = half_wrong.data["rank"].sel(site=site, rounds=rounds)
        heights = np.array([bar.get_height() for bar in ax.containers[0]])
        np.testing.assert_allclose(heights * expected, np.histogram(own, edges)[0])
        band = ax.patches[0].get_data()
        low, high = band.baseline * expected, band.values * expected
        # At most 0.1% of bars end outside of it, and more would if it were narrower.
        outside = binom.cdf(low - 0.5, 400, expected / 400) + binom.sf(high, 400, expected / 400)
        closer = binom.cdf(low, 400, expected / 400) + binom.sf(high - 1, 400, expected / 400)
        assert (outside <= 1e-3).all() and (closer > 1e-3).all()
    bars = colours(axes, lambda ax: ax.containers[0][0].get_facecolor())
    assert bars == [BLUE, BLUE, BLUE, ORANGE]
    assert [ax.get_title() for ax in axes] == ["1 round", "9 rounds", "", ""]


def test_pictures_of_distributions_leave_the_band_where_posteriors_are_rejected(half_wrong):
    axes = grids(plot_ecdf(half_wrong), 4)
    right = ecdf_band(400, 100, RARELY / 2)  # there are two tests
    outside = []
    for ax, (site, rounds) in zip(axes, itertools.product((ODD, "y"), (1, 9)), strict=True):
        own = half_wrong.data["rank"].sel(site=site, rounds=rounds).values
        x, y = ax.lines[0].get_data()
        below = (own[:, None] / 101 < x - 1e-9).mean(0)
        np.testing.assert_allclose(y, below - x, atol=1e-9)
        band = ax.collections[0].get_paths()[0].vertices
        low, high = (
            np.array([pick(band[np.isclose(band[:, 0], place), 1]) for place in x])
            for pick in (np.min, np.max)
        )
        np.testing.assert_allclose([x, x + low, x + high], right, atol=1e-9)
        outside.append(bool(((y < low - 1e-9) | (y > high + 1e-9)).any()))
    assert outside == [False, False, False, True]
    assert colours(axes, lambda ax: ax.lines[0].get_color()) == [BLUE, BLUE, BLUE, ORANGE]


def test_pictures_of_coverage_show_shares_and_errors(half_wrong):
    axes = grids(plot_coverage(half_wrong), 2)
    table = half_wrong.table().set_index(["site", "rounds"])
    for ax, site in zip(axes, (ODD, "y"), strict=True):
        assert ax.get_title() == site
        assert [line.get_ydata()[0] for line in ax.lines if line.get_linestyle() == ":"] == [
            *LEVELS
        ]
        for level, drawn in zip(LEVELS, ax.containers, strict=True):
            name = f"coverage_{100 * level:.0f}"
            line, _, (bars,) = drawn.lines
            np.testing.assert_allclose(line.get_ydata(), table.xs(site)[name])
            ends = np.array([segment[:, 1] for segment in bars.get_segments()])
            reach = 2 * table.xs(site)[f"{name}_se"].to_numpy()
            np.testing.assert_allclose(np.diff(ends)[:, 0] / 2, reach)


def test_pictures_of_one_site_and_of_few_people(rng):
    for picture in (plot_ranks, plot_ecdf, plot_coverage):
        grids(picture(gaussian(rng, 12)), 1)
        grids(picture(gaussian(rng, 1, draws=1)), 1)

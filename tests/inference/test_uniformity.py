"""Tests of uniform ranks: their probabilities, by enumeration and by hand."""

import itertools

import numpy as np
import pytest
from scipy.stats import binom, chisquare, norm

from mirror_ppl.inference.calibration import uniformity
from mirror_ppl.inference.calibration.uniformity import (
    ecdf_band,
    ecdf_p_value,
    histogram_p_value,
    rank_edges,
)


def by_enumeration(number, draws, points):
    """All vectors of ranks, and the smallest of the two-sided tails of each, the plain way."""
    edges = [point * (draws + 1) // points for point in range(1, points)]
    everything = list(itertools.product(range(draws + 1), repeat=number))
    levels = []
    for vector in everything:
        tails = []
        for edge in edges:
            below, share = sum(rank < edge for rank in vector), edge / (draws + 1)
            lower = sum(binom.pmf(count, number, share) for count in range(below + 1))
            upper = sum(binom.pmf(count, number, share) for count in range(below, number + 1))
            tails.append(min(1.0, 2 * lower, 2 * upper))
        levels.append(min(tails))
    return np.array(everything), np.array(levels)


@pytest.fixture
def few_points(request, monkeypatch):
    monkeypatch.setattr(uniformity, "MOST_POINTS", request.param)
    for cached in (uniformity._tails, uniformity.ecdf_band):
        cached.cache_clear()
    yield request.param
    for cached in (uniformity._tails, uniformity.ecdf_band):
        cached.cache_clear()


@pytest.mark.parametrize(
    ("number", "draws", "few_points"),
    [(4, 3, 100), (3, 6, 3), (1, 2, 100)],
    indirect=["few_points"],
)
def test_probabilities_of_the_band_are_exact(number, draws, few_points):
    everything, levels = by_enumeration(number, draws, min(few_points, draws + 1))
    expected = (levels <= levels[:, None] + 1e-9).mean(-1)
    given = [ecdf_p_value(vector, draws) for vector in everything]
    np.testing.assert_allclose(given, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("number", "draws", "power"),
    [(40, 19, 1.0), (40, 19, 1.3), (300, 250, 1.0), (300, 250, 1.1)],
)
def test_ranks_leave_the_band_exactly_if_their_probability_is_small(rng, number, draws, power):
    rate = 0.2  # with these powers, ranks stay inside about as often as they leave
    expected, low, high = ecdf_band(number, draws, rate)
    left = []
    for _ in range(200):
        own = np.floor(rng.random(number) ** power * (draws + 1)).astype(int)
        below = (own[:, None] < np.rint(expected * (draws + 1))).mean(0)
        left.append(bool(((below < low) | (below > high)).any()))
        assert left[-1] == (ecdf_p_value(own, draws) <= rate)
    assert any(left) and not all(left)


def test_the_band_is_wide_in_the_middle_and_ends_at_0_and_1():
    expected, low, high = ecdf_band(500, 200, 1e-3)
    assert (low <= expected).all() and (expected <= high).all()
    assert (expected[0], low[0], high[0]) == (0, 0, 0)
    assert (expected[-1], low[-1], high[-1]) == (1, 1, 1)
    # One point alone would be left outside of 3.29 standard errors; all of them need more.
    half = np.abs(expected - 0.5).argmin()
    errors = (high - low)[half] / 2 / np.sqrt(0.25 / 500)
    assert norm.isf(1e-3 / 2) < errors < norm.isf(1e-3 / 2 / len(expected))


@pytest.mark.parametrize(
    ("number", "draws", "bins"),
    [(500, 199, 20), (200, 99, 10), (100, 8, 4), (39, 99, 4), (9, 1, 2)],
)
def test_bins_expect_twenty_or_there_are_four(number, draws, bins):
    edges = rank_edges(number, draws)
    assert len(edges) == bins + 1
    assert (edges[0], edges[-1]) == (0, draws + 1)
    assert np.ptp(np.diff(edges)) <= 1
    own = np.arange(number) * (draws + 1) // number
    if number < 40:
        assert np.isnan(histogram_p_value(own, draws))
    else:
        assert number * np.diff(edges).min() / (draws + 1) >= 20
        assert histogram_p_value(own, draws) > 0.9


def test_uneven_bins_expect_more_or_less(rng):
    own = rng.integers(8, size=100)  # of 0 .. 8: the last rank is never taken
    counts = [np.isin(own, bin).sum() for bin in ([0, 1], [2, 3], [4, 5], [6, 7, 8])]
    right = chisquare(counts, 100 * np.array([2, 2, 2, 3]) / 9).pvalue
    assert histogram_p_value(own, 8) == pytest.approx(right)

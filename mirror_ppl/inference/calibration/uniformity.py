"""Tests of uniform ranks: by their histogram, and by their cumulative distribution.

N ranks of truths among S draws are compared with the uniform distribution over 0 .. S. The second
test is that of Säilynoja, Bürkner and Vehtari (*Graphical test for discrete uniformity*, 2022): a
simultaneous band around the cumulative distribution with a given probability of leaving it. They
simulate that probability, or compute it by a recursion; here the recursion is a chain of
convolutions, because counts of bins are independent Poisson variables, given their sum.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.stats import binom, chi2, poisson

LEAST_EXPECTED, MOST_BINS = 20, 20
"""Least expected ranks per bin of the histogram, and largest number of bins."""
FEWEST_BINS = 4
"""Bins of a plotted histogram with too few ranks to be tested."""
MOST_POINTS = 100
"""Largest number of points at which the cumulative distribution is compared with the band."""
TOLERANCE = 1e-9
"""Relative tolerance for tails that are equal up to rounding."""


def rank_edges(number: int, draws: int) -> np.ndarray:
    """Edges of the bins of a histogram of ranks, as even as whole numbers allow.

    Args:
        number: number of ranks N.
        draws: S; a rank is one of 0 .. S.

    Returns:
        First ranks of each bin, and S + 1. Each bin expects ``LEAST_EXPECTED`` ranks or more,
        unless there are too few for two such bins.
    """
    values = draws + 1
    for bins in range(min(MOST_BINS, values), 1, -1):
        if number * (values // bins) >= LEAST_EXPECTED * values:
            break
    else:
        bins = min(FEWEST_BINS, values)
    return np.arange(bins + 1) * values // bins


def histogram_p_value(ranks: np.ndarray, draws: int) -> float:
    """P-value of Pearson's chi-square test that ranks ``[N]`` are uniform.

    Returns:
        NaN if there are too few ranks for two bins.
    """
    edges = rank_edges(len(ranks), draws)
    expected = len(ranks) * np.diff(edges) / (draws + 1)
    if expected.min() < LEAST_EXPECTED:
        return np.nan
    counts, _ = np.histogram(ranks, edges)
    statistic = ((counts - expected) ** 2 / expected).sum()
    return float(chi2.sf(statistic, len(expected) - 1))


def ecdf_p_value(ranks: np.ndarray, draws: int) -> float:
    """P-value of the test that the cumulative distribution of ranks ``[N]`` is uniform.

    The statistic is the smallest of the two-sided binomial tails at all points. The p-value is
    exact (0 below about 1e-12).
    """
    edges, tails = _tails(len(ranks), draws)
    below = (ranks[:, None] < edges[1:-1]).sum(0)
    return _leaving(len(ranks), draws, float(tails[np.arange(len(below)), below].min()))


@lru_cache(maxsize=32)
def ecdf_band(
    number: int, draws: int, failure_rate: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The simultaneous band of the cumulative distribution of uniform ranks.

    The band is as narrow as possible: ranks stay inside of it if and only if their
    :func:`ecdf_p_value` is above the failure rate.

    Args:
        number: number of ranks N.
        draws: S; a rank is one of 0 .. S.
        failure_rate: largest probability of leaving the band.

    Returns:
        At each point: the share of ranks expected below it, and the lowest and the highest share
        inside of the band.
    """
    edges, tails = _tails(number, draws)
    # By Bonferroni's inequality the lower end is low enough; no band is narrower than one point's.
    low, high = np.log(failure_rate / len(edges)), np.log(failure_rate)
    if _leaving(number, draws, np.exp(high)) <= failure_rate:
        low = high
    while high - low > TOLERANCE:
        middle = (low + high) / 2
        if _leaving(number, draws, np.exp(middle)) <= failure_rate:
            low = middle
        else:
            high = middle
    inside = tails > np.exp(low) * (1 + TOLERANCE)
    lowest = np.concatenate([[0], inside.argmax(1), [number]])
    highest = np.concatenate([[0], number - inside[:, ::-1].argmax(1), [number]])
    return edges / (draws + 1), lowest / number, highest / number


@lru_cache(maxsize=32)
def _tails(number: int, draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Ranks at the points ``[K + 1]``, and two-sided tails ``[K - 1, N + 1]`` of counts below."""
    points = min(draws + 1, MOST_POINTS)
    edges = np.arange(points + 1) * (draws + 1) // points
    below, share = np.arange(number + 1), edges[1:-1, None] / (draws + 1)
    lower, upper = binom.cdf(below, number, share), binom.sf(below - 1, number, share)
    return edges, np.minimum(2 * np.minimum(lower, upper), 1.0)


def _leaving(number: int, draws: int, level: float) -> float:
    """Probability that the tail at some point is ``level`` or smaller, if ranks are uniform."""
    edges, tails = _tails(number, draws)
    inside = tails > level * (1 + TOLERANCE)
    kernels = {
        width: poisson.pmf(np.arange(number + 1), number * width / (draws + 1))
        for width in np.unique(np.diff(edges))
    }
    # Mass of each count below the point so far, for paths that never left, as Poisson numbers.
    first, mass = 0, np.ones(1)
    for width, allowed in zip(np.diff(edges), [*inside, None], strict=True):
        possible = [number] if allowed is None else np.flatnonzero(allowed)
        if len(possible) == 0:
            return 1.0
        # Both ends of the band rise from point to point.
        lowest, highest = possible[0], possible[-1]
        steps = kernels[width][: highest - first + 1]
        mass = np.convolve(mass, steps)[lowest - first : highest - first + 1]
        first = lowest
    return float(np.clip(1 - mass.sum() / poisson.pmf(number, number), 0.0, 1.0))

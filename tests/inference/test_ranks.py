"""Ranks of the truth: ties, coverage, contraction, and wrong posteriors that have to be found."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy.stats import beta, binom, chisquare, norm

from mirror_ppl.errors import PosteriorError
from mirror_ppl.inference.calibration.ranks import (
    LEVELS,
    Calibration,
    collect,
    join_rounds,
    judge,
    ranks,
)

RARELY = 1e-5
"""Failure rate of what a test may not get wrong, whatever the seed."""


def gaussian(rng, people, draws=100, width=1.0, shift=0.0, sites=("x",)):
    """Posteriors of means, each seen once with noise; prior and noise have variance 1."""
    prior = {site: rng.normal(size=4000) for site in sites}
    return collect(
        [join_rounds({1: judged(rng, people, draws, width, shift, sites)})], prior, (), {}
    )


def judged(rng, people, draws=100, width=1.0, shift=0.0, sites=("x",)):
    """What is judged of such posteriors, made narrower or shifted by so many of their widths."""
    truth, drawn = {}, {}
    for site in sites:
        truth[site] = rng.normal(size=people)
        mean = (truth[site] + rng.normal(size=people)) / 2
        spread = width * rng.normal(size=(draws, people))
        drawn[site] = mean + np.sqrt(0.5) * (shift + spread)
    return judge(truth, drawn, (), rng)


def test_ties_are_broken_evenly(rng):
    number = 9000
    draws = np.repeat([[0], [1], [1], [2]], number, 1)
    counts = np.bincount(ranks(np.ones(number), draws, rng), minlength=5)
    assert counts[0] == counts[4] == 0
    assert chisquare(counts[1:4]).pvalue > RARELY
    np.testing.assert_array_equal(ranks(np.array([-1, 3]), draws[:, :2], rng), [0, 4])


def test_ranks_and_places_are_uniform_where_half_of_the_draws_are_ties(rng):
    number, size = 20000, 9
    truth, draws = rng.random(number) < 0.7, rng.random((size, number)) < 0.7
    one = judge({"x": truth}, {"x": draws}, ["x"], rng).isel(site=0)
    assert chisquare(np.bincount(one["rank"], minlength=size + 1)).pvalue > RARELY
    assert chisquare(np.histogram(one["place"], 50, (0, 1))[0]).pvalue > RARELY


@pytest.mark.parametrize("sure", [True, False])
def test_right_coverage_is_nominal_whatever_the_values(rng, sure):
    """Certain and right: every interval is one point, and holds the truth at its level only."""
    number = 10000
    truth = rng.integers(3, size=number)
    draws = np.repeat(truth[None], 7, 0) if sure else rng.integers(3, size=(7, number))
    judged = judge({"x": truth}, {"x": draws}, ["x"], rng)
    whole = collect([join_rounds({1: judged})], {"x": np.arange(3)}, ["x"], {})
    for level, held in zip(LEVELS, whole.coverage.values[0, 0], strict=True):
        assert binom.cdf(held * number, number, level) > RARELY
        assert binom.sf(held * number - 1, number, level) > RARELY


def test_numbers_by_hand(rng):
    """Two people, four draws; one is certain of the wrong value, one is divided."""
    truth = {"n": np.array([0, 2]), "x": np.array([0.0, 5.0])}
    draws = {
        "n": np.array([[1, 2], [1, 2], [1, 0], [1, 1]]),
        "x": np.array([[0.0, 0], [1, 10], [2, 20], [3, 30]]) + 1,
    }
    judged = judge(truth, draws, ["n"], rng, np.array([0.2, np.nan]))
    prior = {"n": np.array([0, 0, 1, 2]), "x": np.arange(101.0)}
    data = collect([join_rounds({3: judged})], prior, ["n"], {"domain": "none"})
    np.testing.assert_array_equal(data.data["rank"].sel(site="x")[0], [0, 1])
    assert data.data["rank"].sel(site="n").values[0, 0] == 0
    assert data.data["rank"].sel(site="n").values[0, 1] in (2, 3, 4)
    n, x = data.table().set_index("site").loc[["n", "x"]].to_dict("records")
    divided = 1.5 * np.log(2)  # half and two quarters
    assert n["probability"] == 0.25
    assert n["prior_probability"] == pytest.approx(6 / 16)
    assert n["entropy"] == pytest.approx(divided / 2)
    assert n["prior_entropy"] == pytest.approx(divided)
    assert n["contraction"] == pytest.approx(0.5)
    # Quantiles of four numbers d apart are 0.9 * 3 d from each other.
    np.testing.assert_allclose(data.data["width"].sel(site="x")[0], [2.7, 27])
    assert data.data["prior_width"].sel(site="x") == pytest.approx(90)
    assert x["contraction"] == pytest.approx(1 - (2.7 + 27) / 2 / 90)
    assert np.isnan([x["probability"], x["entropy"], x["prior_entropy"]]).all()
    assert n["rounds"] == x["rounds"] == 3
    assert n["high_pareto_k"] == x["high_pareto_k"] == 0.5
    assert np.isnan(x["p_histogram"]) and x["p_value"] == x["p_ecdf"]
    # As under a flat prior: of two people, so many are held and the others are not.
    assert x["coverage_50_se"] == pytest.approx(
        beta(2 * x["coverage_50"] + 1, 3 - 2 * x["coverage_50"]).std()
    )


def test_right_posteriors_are_rejected_as_rarely_as_said(rng):
    """At a rate of 10%, from 5% to 10% of 200 correct posteriors are rejected, but for chance."""
    sites = [f"x{number}" for number in range(200)]
    data = replace(gaussian(rng, 200, sites=sites), failure_rate=0.1)
    assert binom.cdf(len(data.rejected), 200, 0.05) > RARELY
    assert binom.sf(len(data.rejected) - 1, 200, 0.1) > RARELY
    table = data.table()
    assert len(data.rejected) == (table["p_value"] < 0.1).sum() > 0
    twice = 2 * table[["p_histogram", "p_ecdf"]].min(axis=1).clip(upper=0.5)
    np.testing.assert_allclose(table["p_value"], twice)
    assert not replace(data, failure_rate=RARELY / 200).rejected


@pytest.mark.parametrize(("width", "shift"), [(0.5, 0), (2, 0), (1, 0.7), (1, -0.7)])
def test_wrong_posteriors_are_rejected_and_cover_what_they_should(rng, width, shift):
    """The truth less the posterior's mean is normal, so coverage is known by arithmetic."""
    people, draws = 400, 4000
    wrong = gaussian(rng, people, draws, width, shift)
    assert wrong.rejected == [("x", 1)]
    row = wrong.table().iloc[0]
    assert (row["p_ecdf"] < 1e-3) and (row["p_histogram"] < 1e-3)
    for level in LEVELS:
        reach = width * norm.ppf((1 + level) / 2)
        held = norm.cdf(shift + reach) - norm.cdf(shift - reach)
        # The ends of intervals are known to a hundredth with so many draws.
        slack = 0.01 + norm.isf(RARELY) * np.sqrt(held * (1 - held) / people)
        assert row[f"coverage_{100 * level:.0f}"] == pytest.approx(held, abs=slack)
    assert 1 - row["contraction"] == pytest.approx(width * np.sqrt(0.5), rel=0.1)


def test_files_hold_everything(rng, tmp_path):
    data = replace(gaussian(rng, 50, width=0.3, sites=("x", "y")), failure_rate=0.01)
    data = replace(data, data=data.data.assign_attrs(domain="driving", seed="3"))
    data.save(tmp_path / "new" / "calibration.nc")
    again = Calibration.load(tmp_path / "new" / "calibration.nc")
    xr.testing.assert_identical(again.data, data.data)
    assert (again.failure_rate, again.draws) == (0.01, 100)
    assert again.rejected == data.rejected != []
    pd.testing.assert_frame_equal(again.table(), data.table())
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["calibration.nc"]


def test_files_that_are_no_calibration(rng, tmp_path):
    path = tmp_path / "calibration.nc"
    with pytest.raises(PosteriorError, match="there is no such file"):
        Calibration.load(path)
    path.write_bytes(b"nothing")
    with pytest.raises(PosteriorError, match="is not a netCDF file"):
        Calibration.load(path)
    data = gaussian(rng, 5)
    replace(data, data=data.data.drop_vars("prior_width")).save(path)
    with pytest.raises(PosteriorError, match="cannot be read as a calibration"):
        Calibration.load(path)


def test_a_failure_rate_is_a_probability(rng):
    for rate in (0, 1, -0.1):
        with pytest.raises(ValueError, match="failure_rate must be between 0 and 1, not"):
            replace(gaussian(rng, 5), failure_rate=rate)

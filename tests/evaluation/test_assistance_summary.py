"""What pairings of communicators and people show: means, errors, intervals, by hand."""

import json
import math

import numpy as np
import pytest

from mirror_ppl.evaluation.assistance_summary import compare, summarize_assistance
from mirror_ppl.evaluation.played import Played


def rounds_of(task, cost, items=0, relevant=0, milliseconds=1.0):
    """Rounds made by hand; items are utterances of the first round."""
    number = len(task)
    spoken = [items] + [0] * (number - 1)
    right = [relevant] + [0] * (number - 1)
    nothing = [0] * number
    return Played(
        task=task,
        cost=cost,
        mishaps=[1] + [0] * (number - 1),
        items={"visual": nothing, "verbal": spoken},
        relevant={"course": {"visual": nothing, "verbal": right}},
        communicable={"visual": 10, "verbal": 10},
        steps=5 * number,
        milliseconds=milliseconds,
    )


ZERO = [0.0] * 4
PLAYED = {
    "some": [
        rounds_of([1.0, 2.0, 3.0, 6.0], [0.5] * 4, items=6, relevant=3, milliseconds=2.0),
        rounds_of([0.0, 0.0, 4.0, 4.0], ZERO, items=2, relevant=1, milliseconds=4.0),
    ],
    "none": [rounds_of([0.0, 1.0, 1.0, 2.0], ZERO), rounds_of([-1.0, 0.0, 1.0, 0.0], ZERO)],
    "oracle": [rounds_of([4.0, 4.0, 5.0, 7.0], ZERO), rounds_of([4.0, 3.0, 4.0, 5.0], ZERO)],
}


def test_means_are_those_of_rounds():
    entry = summarize_assistance(PLAYED)["some"]
    assert (entry["task"], entry["cost"], entry["net"]) == (2.5, 0.25, 2.25)
    assert entry["net_by_person"] == [2.5, 2.0]
    assert entry["mishaps"] == 2 / 8
    assert entry["items"] == {"visual": 0.0, "verbal": pytest.approx(8 / (8 * 5))}
    assert entry["relevant"] == {"course": {"all": 4 / 8, "visual": None, "verbal": 4 / 8}}
    assert entry["milliseconds"] == 3.0


def test_the_standard_error_is_that_of_rounds_within_people():
    # Variances 14/3 and 16/3 of four rounds each; people are given, not drawn.
    expected = math.sqrt((14 / 3 / 4 + 16 / 3 / 4) / 4)
    assert summarize_assistance(PLAYED)["some"]["net_se"] == pytest.approx(expected)
    single = {"none": [rounds_of([1.0], [0.0]), rounds_of([9.0], [0.0])]}
    assert summarize_assistance(single)["none"]["net_se"] is None


def test_the_standard_error_is_the_spread_of_means_that_are_drawn_again(rng):
    """The spread of 400 means is what their standard errors say."""
    means, errors = [], []
    for _ in range(400):
        task = rng.normal([[0.0], [5.0]], [[1.0], [3.0]], (2, 12))
        parts = [rounds_of(list(row), [0.0] * 12) for row in task]
        entry = summarize_assistance({"some": parts})["some"]
        means.append(entry["net"])
        errors.append(entry["net_se"])
    # A standard deviation of 400 draws is known to 1 / sqrt(800) of it; 4 of these.
    assert np.std(means, ddof=1) == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=4 / 28.3)


def test_the_way_to_the_oracle_goes_from_none_to_the_oracle():
    summary = summarize_assistance(PLAYED)
    assert summary["none"]["way_to_oracle"] == {"mean": 0.0, "low": 0.0, "high": 0.0}
    assert summary["oracle"]["way_to_oracle"] == {"mean": 1.0, "low": 1.0, "high": 1.0}
    assert summary["none"]["over_none"] == {"mean": 0.0, "low": 0.0, "high": 0.0}
    some = summary["some"]
    assert some["over_none"]["mean"] == pytest.approx(2.25 - 0.5)
    assert some["way_to_oracle"]["mean"] == pytest.approx((2.25 - 0.5) / (4.5 - 0.5))
    for interval in (some["over_none"], some["way_to_oracle"]):
        assert interval["low"] < interval["mean"] < interval["high"]


def test_one_round_of_each_has_no_interval():
    single = {
        name: [rounds_of(part.task[:1], part.cost[:1]) for part in parts]
        for name, parts in PLAYED.items()
    }
    entry = summarize_assistance(single)["some"]
    for name in ("over_none", "way_to_oracle"):
        assert (entry[name]["low"], entry[name]["high"]) == (None, None)
    difference = compare(single, "some", "none")
    assert difference == {"mean": entry["over_none"]["mean"], "low": None, "high": None}


def test_ways_are_left_out_where_there_is_nowhere_to_go():
    summary = summarize_assistance({name: PLAYED[name] for name in ("some", "none")})
    assert all("way_to_oracle" not in entry for entry in summary.values())
    assert "over_none" in summary["some"]
    alone = summarize_assistance({"some": PLAYED["some"]})["some"]
    assert "over_none" not in alone
    level = {"none": PLAYED["none"], "oracle": PLAYED["none"]}
    assert all("way_to_oracle" not in entry for entry in summarize_assistance(level).values())


def test_without_messages_there_is_no_share_of_relevant_ones():
    entry = summarize_assistance(PLAYED)["none"]
    assert entry["relevant"] == {"course": {"all": None, "visual": None, "verbal": None}}
    assert entry["items"] == {"visual": 0.0, "verbal": 0.0}


def test_one_seed_gives_one_summary_that_is_plain_data():
    summary = summarize_assistance(PLAYED, seed=3)
    assert summarize_assistance(PLAYED, seed=3) == summary
    assert summarize_assistance(PLAYED, seed=4) != summary
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


def test_intervals_hold_the_truth_as_often_as_they_say(rng):
    """At least three quarters of 150 intervals at 90% hold the true difference.

    Percentile intervals of 2 x 12 rounds are a little narrow (about 87%); fewer than 75% of 150
    would be over 4 standard deviations off.
    """
    held = 0
    for _ in range(150):
        silence = rng.normal(0, 2, (2, 12))
        spoken = silence + rng.normal(1, 1, (2, 12))
        parts = {
            name: [rounds_of(list(row), [0.0] * 12) for row in task]
            for name, task in (("one", spoken), ("other", silence))
        }
        interval = compare(parts, "one", "other")
        held += interval["low"] <= 1 <= interval["high"]
    assert 0.75 * 150 <= held < 150


def test_compare_pairs_the_rounds():
    found = compare(PLAYED, "some", "none")
    expected = summarize_assistance(PLAYED)["some"]["over_none"]
    assert found["mean"] == expected["mean"] == pytest.approx(1.75)
    assert found["low"] < 1.75 < found["high"]
    back = compare(PLAYED, "none", "some")
    assert back == pytest.approx({"mean": -1.75, "low": -found["high"], "high": -found["low"]})
    # However much rounds differ, a difference that is the same in all of them is certain.
    better = [
        rounds_of(list(np.asarray(one.task) + 0.25), list(one.cost)) for one in PLAYED["oracle"]
    ]
    steady = compare(PLAYED | {"better": better}, "better", "oracle")
    assert steady == pytest.approx({"mean": 0.25, "low": 0.25, "high": 0.25})

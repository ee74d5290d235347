"""What studies show: means, pairs and shares against numbers worked out by hand."""

import numpy as np
import pytest

from mirror_ppl.evaluation.study_report import REPORTS, difference
from mirror_ppl.evaluation.study_summary import (
    Interval,
    Place,
    few_against_many,
    floors,
    interval,
    paired,
    relevance,
    summarize_study,
    ways_to_oracle,
)

FOG = Place("driving", "fog", "paper")


def row(model, rounds, person="a", seed=0, place=FOG, **columns):
    return {
        **place._asdict(),
        "seed": seed,
        "person": person,
        "model": model,
        "rounds": rounds,
    } | columns


def test_the_interval_of_equal_people_is_a_point():
    found = interval(np.full(7, 0.25))
    assert (found.mean, found.low, found.high) == (0.25, 0.25, 0.25)


def test_one_person_has_no_interval():
    found = interval(np.array([0.3]))
    assert found.mean == 0.3 and np.isnan([found.low, found.high]).all()
    assert difference(found, 2) == "+0.30\n(one person)"
    assert difference(interval(np.array([0.3, 0.3])), 2) == "+0.30\n[+0.30, +0.30]"


def test_the_interval_of_many_people_is_that_of_the_normal():
    """1.645 standard errors to either side; resamples err by 1.645 * sqrt(.05 * .95 / 2000) / .103
    = .078 standard errors at most in 90 of 100 cases, twice that is allowed."""
    values = np.random.default_rng(1).normal(size=400)
    found = interval(values)
    error = values.std() / 20
    assert abs((found.high - found.mean) / error - 1.645) < 0.16
    assert abs((found.mean - found.low) / error - 1.645) < 0.16


def test_pairs_cancel_what_people_have_in_common():
    people = np.array([0.0, 10.0, -5.0, 3.0])
    found = paired(people + 1, people)
    assert (found.ahead.mean, found.ahead.low, found.ahead.high) == (1.0, 1.0, 1.0)
    assert (found.improvement.mean, found.people) == (1.0, 4)


def test_ties_count_half():
    assert (
        paired(np.array([1.0, 2.0, 3.0, 0.0]), np.array([0.0, 2.0, 3.0, 5.0])).improvement.mean
        == 0.5
    )


def test_less_can_be_better_and_people_are_matched_by_seed_and_name():
    rows = [
        row("mirror", 1, "a", 0, nll=0.1),
        row("mirror", 1, "a", 1, nll=0.3),
        row("bc", 1, "a", 1, nll=0.4),
        row("bc", 1, "a", 0, nll=0.3),
        row("bc", 5, "a", 0, nll=0.2),
    ]
    mirror, one, five = summarize_study(rows, "nll", -1)
    assert (mirror.model, mirror.rounds, mirror.people, mirror.mirror) == ("mirror", 1, 2, None)
    assert mirror.measured.mean == pytest.approx(0.2)
    assert one.mirror is not None
    assert one.mirror.ahead.mean == pytest.approx(0.15)  # .2 and .1
    assert one.mirror.improvement.mean == 1.0
    assert five.mirror is None  # mirror has not learned from five rounds


def test_who_learns_nothing_is_compared_with_the_most_rounds():
    rows = [row("mirror", 5, net=1.0), row("mirror", 1, net=0.0), row("none", 0, net=-2.0)]
    none = summarize_study(rows, "net")[-1]
    assert none.mirror is not None
    assert none.mirror.ahead.mean == 3.0


def test_who_has_a_prior_is_compared_with_as_little():
    rows = [row("mirror", 5, net=1.0), row("mirror", 0, net=0.5), row("no-implants", 0, net=-2.0)]
    found = summarize_study(rows, "net")[-1].mirror
    assert found is not None
    assert found.ahead.mean == 2.5


def test_who_pools_is_compared_with_mirror_pooled():
    rows = [row("mirror", 1, nll=0.3), row("mirror-pooled", 1, nll=0.2)]
    rows += [row("logistic", 1, nll=0.25), row("bc", 1, nll=0.25)]
    mirror, pooled, logistic, bc = summarize_study(rows, "nll", -1)
    assert mirror.mirror is None
    assert [one.mirror.ahead.mean for one in (pooled, logistic, bc)] == pytest.approx(  # pyright: ignore
        [-0.1, 0.05, -0.05]
    )


def test_the_way_to_the_oracle_and_what_was_learned_of_people_on_it():
    """Mirror gains 2 of the 4 between silence and the oracle unlearned, 3 after five rounds."""
    rows = []
    for person in "ab":
        for model, rounds, net in (
            ("none", 0, -5.0),
            ("oracle", 0, -1.0),
            ("mirror", 0, -3.0),
            ("mirror", 5, -2.0),
        ):
            rows.append(row(model, rounds, person, net=net))
    ways = {(one.model, one.rounds): one for one in ways_to_oracle(rows)}
    assert ways["mirror", 0].share == Interval(0.5, 0.5, 0.5)
    assert ways["mirror", 5].share == Interval(0.75, 0.75, 0.75)
    assert ways["mirror", 0].learned is None
    assert ways["mirror", 5].learned == Interval(1.0, 1.0, 1.0)
    assert ways["oracle", 0].share == Interval(1.0, 1.0, 1.0)
    assert ways["none", 0].share == Interval(0.0, 0.0, 0.0)
    # Without an oracle there is no way to it.
    assert all(one.share is None for one in ways_to_oracle(rows[:1] + rows[2:4]))


def test_places_are_apart():
    clear = Place("driving", "clear", "paper")
    rows = [row("mirror", 1, nll=0.1), row("bc", 1, nll=0.3, place=clear)]
    here, there = summarize_study(rows, "nll", -1)
    assert (here.place, there.place) == (FOG, clear)
    assert there.mirror is None


def test_few_rounds_of_mirror_are_against_the_most_of_baselines():
    rows = [
        row("mirror", 2, nll=0.2),
        row("mirror", 1, nll=0.25),
        row("bc", 1, nll=0.9),
        row("bc", 20, nll=0.35),
        row("policy-only", 20, nll=0.0),
    ]
    (claim,) = few_against_many(rows, "nll", -1)
    assert (claim.rounds, claim.baseline, claim.baseline_rounds) == (1, "bc", 20)
    assert claim.paired.ahead.mean == pytest.approx(0.1)


def test_shares_are_of_all_items_and_of_each_modality():
    told = {"items_visual": 4, "items_verbal": 0, "goal_visual": 3, "goal_verbal": 0}
    more = {"items_visual": 0, "items_verbal": 6, "goal_visual": 0, "goal_verbal": 3}
    silent = dict.fromkeys(told, 0)
    rows = [row("bc", 20, "a", **told), row("bc", 20, "b", **more), row("none", 0, "a", **silent)]
    shares = {
        (one.model, one.modality): one for one in relevance(rows, "goal", ["visual", "verbal"])
    }
    for modality, items, mean in (("all", 10, 0.6), ("visual", 4, 0.75), ("verbal", 6, 0.5)):
        one = shares["bc", modality]
        assert one.share is not None
        assert (one.items, one.share.mean) == (items, mean)
    # Only resamples without the other person differ: .75 and .5 of what is told.
    assert shares["bc", "all"].share.low == 0.5
    assert shares["bc", "all"].share.high == 0.75
    assert shares["none", "all"].share is None
    assert shares["none", "all"].items == 0


def test_shares_are_compared_in_people_who_got_messages_from_both():
    """Mirror 1/2, 2/2 and 1/4 of three people; bc 1/4, none and 1/2: ahead by 1/4 and -1/4."""

    def told(model, rounds, person, items, goal):
        return row(model, rounds, person, items_visual=items, goal_visual=goal)

    rows = [
        *(told("mirror", 20, *one) for one in (("a", 2, 1), ("b", 2, 2), ("c", 4, 1))),
        *(told("bc", 20, *one) for one in (("a", 4, 1), ("b", 0, 0), ("c", 2, 1))),
        *(told("all", 0, *one) for one in (("a", 10, 1), ("b", 10, 1), ("c", 10, 1))),
        *(told("none", 0, *one) for one in (("a", 0, 0), ("b", 0, 0), ("c", 0, 0))),
    ]
    shares = {one.model: one for one in relevance(rows, "goal", ["visual"])}
    assert shares["mirror"].mirror is None and shares["none"].mirror is None
    bc, everything = shares["bc"].mirror, shares["all"].mirror
    assert bc is not None and everything is not None
    assert (bc.people, bc.ahead.mean, bc.improvement.mean) == (2, 0.0, 0.5)
    assert everything.people == 3
    assert everything.ahead.mean == pytest.approx((0.4 + 0.9 + 0.15) / 3)
    assert everything.improvement.mean == 1.0


def test_floors_count_each_person_once():
    rows = [
        row("mirror", 1, "a", floor=0.1),
        row("bc", 1, "a", floor=0.1),
        row("mirror", 1, "b", floor=0.4),
    ]
    assert floors(rows) == {FOG: pytest.approx(0.25)}
    assert floors([*rows, row("mirror", 1, "c", floor=None)]) == {}


def test_tables_say_where_a_person_is_missing():
    """A cell of bc failed: its mean is of one person, and the advantage over it, too."""
    rows = [
        Place("driving", "fog", "paper")._asdict()
        | {"seed": seed, "person": "a", "model": model, "rounds": 1}
        | {"nll": nll, "accuracy": 0.5, "floor": 0.1}
        for seed, model, nll in ((0, "mirror", 0.2), (1, "mirror", 0.4), (1, "bc", 0.5))
    ]
    nll, accuracy = REPORTS["prediction"](rows).tables
    assert "mean over 2 people" in nll.caption
    assert dict(nll.rows) == {
        "mirror": "0.300",
        "bc": "0.500 (1 of 2 people)\n+0.100\n(one person)\n100%",
    }
    assert dict(accuracy.rows)["bc"] == "0.500 (1 of 2 people)\n+0.000\n(one person)\n50%"

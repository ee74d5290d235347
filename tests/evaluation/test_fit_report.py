"""What a fit prints: one table where it fits, several below each other where it does not."""

from __future__ import annotations

import pytest

from mirror_ppl.evaluation import fit_report
from mirror_ppl.evaluation.fit_report import show_fit

SITES = ("sight_radius", "consistency", "rule_type_a")


def person(number):
    implants = {
        name: {"median": place + 0.5, "q05": 0.0, "q95": 3.0, "truth": None}
        for place, name in enumerate(SITES[:2])
    }
    implants["rule_type_a"] = {"most_probable": "left first", "probability": 0.75}
    test = {"nll": 0.25, "floor": 0.125, "accuracy": 0.5} if number == 1 else None
    check = {"verdict": "ok", "reasons": [], "p_values": {"delayed": 0.4}}
    check |= {"nll_base_rate": None, "nll_no_implants": None}
    if test:
        check |= {"nll_base_rate": 0.375, "nll_no_implants": 0.625}
    return {
        "id": f"person-0{number}",
        "engine": "importance",
        "implants": implants,
        "test": test,
        "check": check,
    }


def shown(capsys, **changes):
    summary = {"domain": "driving", "setting": "fog", "people": [person(1), person(2)]}
    summary["contradictions"] = {"steps": 10, "contradicting": 0}
    summary["prior_conflicts"] = summary["several_numbers"] = {}
    show_fit(summary | changes, "cells")
    return capsys.readouterr().out


@pytest.mark.parametrize(("width", "tables"), [(184, 2), (60, 4), (35, 8)])
def test_columns_stand_below_each_other_where_there_is_no_room(width, tables, capsys, monkeypatch):
    monkeypatch.setattr(fit_report, "WIDTH", width)
    out = shown(capsys)
    assert out.count("person-01") == out.count("┏") == tables
    texts = "radius", "0.50 [0, 3]", "1.50 [0, 3]", "left first (0.75)", "0.125", "0.375", "0.625"
    for text in texts:
        assert text in out
    assert out.count("consistency") == 1
    assert all(len(line) <= width for line in out.splitlines() if "│" in line)


def test_a_newcomer_stands_below_people(capsys):
    implants = person(1)["implants"]
    implants["consistency"] = {"median": 9.5, "q05": 9.0, "q95": 10.0}
    implants["sight_radius"] = {"median": 2.0, "q05": 1.0, "q95": 3.0}
    out = shown(capsys, newcomer=implants)
    (line,) = (line for line in out.splitlines() if "newcomer" in line)
    assert "9.50 [9, 10]" in line
    assert "newcomer" not in shown(capsys)


def test_scores_are_explained_if_there_are_any(capsys):
    assert "How held-out actions are predicted, and whether" in shown(capsys)
    found = shown(capsys, people=[person(1) | {"test": None}])
    assert "Whether the model explains each person" in found and "NLL" not in found


def test_unreliable_results_are_reported(capsys):
    doubtful = [person(1) | {"pareto_k": 0.8}, person(2) | {"pareto_k": 0.6}]
    assert "not to be relied on for person-01 (Pareto k above 0.7)" in shown(
        capsys, people=doubtful
    )
    conflict = {"consistency": {"people": 2, "of": 2, "median": 13.0, "prior": [0.9, 10.3]}}
    assert (
        "prior of consistency is at odds with 2 of 2 people: 99% of it is from 0.9 to 10.3"
        in shown(capsys, prior_conflicts=conflict)
    )
    few = [person(1) | {"effective_draws": 30}, person(2) | {"effective_draws": 19}]
    assert "Fewer than 20 effective draws under the population for person-02" in shown(
        capsys, people=few
    )
    few[1]["rounds"] = 0  # who did nothing is not at odds with it
    assert "effective draws" not in shown(capsys, people=few)
    assert "relied on" not in shown(capsys)
    assert "at odds" not in shown(capsys)


def test_people_whom_the_model_does_not_explain_are_reported_with_reasons(capsys):
    assert "Model check: 2 of 2 people ok" in shown(capsys)
    late = person(2)
    late["check"] |= {"verdict": "suspect", "reasons": ["acts late (p < 0.0005)", "earns less"]}
    out = shown(capsys, people=[person(1), late])
    assert "Model check: 1 of 2 people ok" in out
    assert "person-02 suspect: acts late (p < 0.0005); earns less" in out
    out = shown(capsys, people=[late] * 22)
    assert out.count("earns less") == 20 and "and 2 more, in summary.json" in out


def test_posterior_entropy_and_the_most_informative_scenario_are_printed(capsys):
    def opened(entropy, expected):
        return {
            "entropy": {"together": entropy},
            "shared_with_policy": {"together": 0.5},
            "scenarios": {"one car": {"expected": 0.1}, "two cars": {"expected": expected}},
        }

    people = [
        person(1) | {"identifiability": opened(1.0, 0.0)},
        person(2) | {"identifiability": opened(2.0, 0.4)},
    ]
    out = shown(capsys, people=people)
    assert "perceptual implants: 1.50 nats on average (0.50 shared with the policy implants)" in out
    assert 'scenario: "two cars" (expected information gain 0.20 nats)' in out

    people[0]["identifiability"] = opened(0.006, 0.0)
    people[1]["identifiability"] = opened(0.001, 0.0)
    assert "perceptual implants: 0.00 nats on average" in shown(capsys, people=people)
    for one in people:
        one["identifiability"] = opened(0.5, 0.0)
        one["identifiability"]["scenarios"]["one car"]["expected"] = 0.004
    assert "informative" not in shown(capsys, people=people)


def test_people_who_notice_things_have_no_reach(capsys):
    some = person(1)
    some["implants"] = {"notices_terminal 1": some["implants"]["consistency"]}
    nothing = {"together": 0.0}
    some["identifiability"] = {"entropy": nothing, "shared_with_policy": nothing, "scenarios": {}}
    out = shown(capsys, people=[some])
    assert "perceptual implants: none, not counting how soon they notice things" in out
    assert "What each person notices (probability at a step) and" in shown(capsys, people=[some])
    assert "What each person sees (cells) and" in shown(capsys)


def test_the_engine_of_each_person_is_reported(capsys):
    assert "Inferred by the engine importance: 2 of 2 people\n" in shown(capsys)
    people = [person(1), person(2), person(3) | {"engine": "amortized"}]
    told = "Inferred by the engine importance: 2 of 3 people; amortized: person-03\n"
    assert told in shown(capsys, people=people)


def test_what_was_not_held_out_is_not_judged(capsys):
    summary = {"people": [person(2)]}
    assert "No rounds were held out" in shown(capsys, **summary)
    assert "0.250 nats an action on average, 0.125 above" in shown(capsys)


def test_the_excess_over_entropies_is_of_those_whose_entropy_is_known(capsys):
    first, second = person(1), person(2)
    second["test"] = first["test"] | {"nll": 1.25, "floor": None}
    out = shown(capsys, people=[first, second])
    assert "0.750 nats an action on average, 0.125 above the people's own entropy, which is" in out
    assert "which is known of 1 of 2" in out
    assert "known of" not in shown(capsys, people=[first])

"""What a comparison must not get wrong: what learners read, floors, costs and intervals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from example_groups import FewReaches

from mirror_ppl.communication.hearing import HearingPerson, hearing
from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.planners import PlannerOptions
from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.driving import Driving
from mirror_ppl.evaluation import study
from mirror_ppl.evaluation.assistance import speaker
from mirror_ppl.evaluation.learners import TEST, VALIDATION, Group, learn
from mirror_ppl.evaluation.reachable_oracle import _small_messages
from mirror_ppl.evaluation.study import Assistance, Prediction, assist, predict
from mirror_ppl.evaluation.study_summary import ways_to_oracle
from mirror_ppl.inference.results.summary import summarize

GROUP = FewReaches("driving", "fog", "paper", 2, 100)
LEARNED_FROM = 2
QUICK = ["mirror", "no-implants", "base-rate", "logistic", "bc", "bc-pooled", "sqil"]


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    """SQIL takes few steps: what it reads does not depend on their number."""
    baselines = Driving.record.baselines
    fewer = {**baselines, "sqil": {**baselines.get("sqil", {}), "epochs": 30}}
    monkeypatch.setattr(Driving, "record", replace(Driving.record, baselines=fewer))


def with_others_rounds(changed):
    """The recordings with some rounds of other people in the place of their own."""
    own, other = GROUP.recordings(), replace(GROUP, seed=101).recordings()
    variables = own.variables()
    for name, value in other.variables().items():
        if value.dim() > 1:  # of rounds
            variables[name] = variables[name].clone()
            variables[name][:, changed] = value[:, changed]
    return Demonstrations.from_variables(
        own.domain, own.setting, own.people, variables, own.provenance
    )


@cache
def predictions(name, rounds=LEARNED_FROM):
    """What a learner predicts of held-out rounds."""
    test = GROUP.recordings().select_rounds(TEST)
    return learn(name, GROUP, rounds, 0).log_predictive(test)


def changed_predictions(name, monkeypatch, changed, rounds=LEARNED_FROM):
    """What it predicts of the same rounds when others' rounds are in the place of some."""
    test = GROUP.recordings().select_rounds(TEST)
    recordings = with_others_rounds(changed)
    with monkeypatch.context() as patch:
        patch.setattr(Group, "recordings", lambda self, number=36: recordings)
        return learn(name, GROUP, rounds, 0).log_predictive(test)


@pytest.mark.parametrize("name", QUICK)
def test_nobody_reads_held_out_rounds_or_rounds_that_are_not_theirs_yet(name, monkeypatch):
    """Whatever is in them, the same is learned."""
    places = range(GROUP.recordings().shape[1])
    unread = [*places[LEARNED_FROM : VALIDATION.start], *places[TEST]]
    own = predictions(name)
    assert torch.equal(changed_predictions(name, monkeypatch, unread), own)
    # The test can fail: with other rounds to learn from something else is learned.
    assert not torch.equal(changed_predictions(name, monkeypatch, slice(LEARNED_FROM)), own)


@pytest.mark.parametrize("name", ["mirror", "no-implants", "base-rate"])
def test_only_baselines_read_validation_rounds(name, monkeypatch):
    own = predictions(name)
    assert torch.equal(changed_predictions(name, monkeypatch, VALIDATION), own)


def test_baselines_do(monkeypatch):
    own = predictions("bc", rounds=20)
    assert not torch.equal(changed_predictions("bc", monkeypatch, VALIDATION, 20), own)


def test_the_floor_is_the_entropy_of_what_was_held_out():
    """The mean over their actions, by hand."""
    rows = predict(Prediction(GROUP, "base-rate", 1))
    test = GROUP.recordings().select_rounds(TEST)
    assert test.action_entropy is not None
    for person, row in enumerate(rows):
        real = test.actions[person] >= 0
        own = test.action_entropy[person][real].double().mean()
        assert row["floor"] == pytest.approx(float(own), rel=1e-6)
        nll = -learn("base-rate", GROUP, 1, 0).log_predictive(test)[person]
        done = test.actions[person].clamp(min=0)[..., None]
        assert row["nll"] == pytest.approx(
            float(nll.gather(-1, done)[..., 0][real].mean()), rel=1e-5
        )


def test_net_returns_are_less_the_cost_of_messages_the_oracles_too():
    rows = [
        row
        for name in ("none", "oracle", "nearest")
        for row in assist(Assistance(GROUP, name, 0, 2, 0))
    ]
    for row in rows:
        assert row["net"] == pytest.approx(row["task"] - row["cost"])
    cost = {row["model"]: row["cost"] for row in rows if row["person"] == "person-01"}
    assert cost["none"] == 0 < cost["oracle"] < cost["nearest"]
    (way,) = [one for one in ways_to_oracle(rows) if one.model == "nearest"]
    net = {
        name: np.mean([row["task"] - row["cost"] for row in rows if row["model"] == name])
        for name in cost
    }
    expected = (net["nearest"] - net["none"]) / (net["oracle"] - net["none"])
    assert way.share is not None and way.share.mean == pytest.approx(expected)


@pytest.mark.parametrize(("name", "asks"), [("bc", False), ("no-implants", True)])
def test_planners_of_networks_find_out_nothing_about_hearing(name, asks, monkeypatch):
    """As the page of the communicator says; human models ask, with the usual probability."""
    people = []

    def nobody_speaks(objective, listener, options, seed):
        people.append(hearing(listener.person, options.hears))
        return speaker("none", listener, options, seed)

    monkeypatch.setattr(study, "speaker", nobody_speaks)
    assist(Assistance(GROUP, name, 1, 1, 4))
    assert [isinstance(one, HearingPerson) for one in people] == [asks, asks]


@pytest.mark.parametrize("name", ["search_rescue", "bomb_defusal"])
def test_the_oracle_considers_every_pair_of_items(name):
    """As many as a planner's messages have: silence, each alone, and each pair."""
    domain = get_domain(name)
    found = _small_messages(domain)
    channels = Channels(domain)
    open_to = ~channels.join(domain.known(domain.nothing_known()))
    number = int(open_to.sum())
    assert len(found) == 1 + number + number * (number - 1) // 2
    assert not found[:, ~open_to].any() and not found[0].any()
    assert found.sum(-1).max() == PlannerOptions.of(name).items == 2


def test_intervals_of_summaries_hold_nine_tenths():
    """Draws 0 to 100 have quantiles 5, 50 and 95."""
    rounds = GROUP.recordings().select_rounds(slice(1)).select_people([0])
    (found,) = summarize({"site": torch.arange(101.0)[:, None]}, rounds, None)
    implant = found["implants"]["site"]
    assert (implant["q05"], implant["median"], implant["q95"]) == (5, 50, 95)

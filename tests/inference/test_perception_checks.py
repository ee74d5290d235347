"""Checks of perception against what is worked out by hand, and people who miss or forget."""

import math
from dataclasses import replace

import pytest
import torch

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.results import perception_checks
from mirror_ppl.inference.results.checks import more_often
from mirror_ppl.inference.results.criticism import verdict
from mirror_ppl.inference.results.perception_checks import (
    DELAYS,
    PerceivedOtherwise,
    missing,
    perception_p_values,
)
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.likelihood.combinations import perceived_sites
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.models import HumanModel
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.view import View
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def human():
    return HumanModel(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def rounds():
    recordings = load_demonstrations(asset_path("driving_fog_diverse.nc"))
    return recordings.select_people([1]).select_rounds(range(3))


@pytest.fixture
def again(human, rounds):
    """Three rounds under two draws."""
    draws = draw_prior(human, 1, 2, 3)
    for site, bins in zip(sight_sites(human.domain), [[4, 6], [3, 5], [2, 6], [5, 3]], strict=True):
        draws[site] = torch.tensor(bins).view(2, 1, 1)
    return PerceivedOtherwise(human, tuple(perceived_sites(human)), rounds_of(rounds, 0), draws)


def test_rounds_are_perceived_as_in_predictions(human, rounds, again):
    predicted = predict_rounds(human, rounds, again.draws)[:, 0].flatten(0, 1)
    real = again.rounds.real[again.row]
    torch.testing.assert_close(again.log_probabilities[real], predicted[real])


def test_who_sees_nothing_of_all_items_sees_nothing(again):
    """As people of a model who see nothing."""
    blind = replace(again, human=Blind(again.human.self_model))
    shape = (*again.rounds.actions[again.row].shape, 4)
    unseen = {"visual": torch.ones(shape, dtype=torch.bool), "verbal": torch.zeros(shape).bool()}
    beliefs, which = again._believed(missing(again.human, unseen), again.row, again.drawn)
    wanted, place = blind._believed(blind.human, again.row, again.drawn)
    real = again.rounds.real[again.row]
    torch.testing.assert_close(beliefs[which][real], wanted[place][real])


def test_who_forgets_all_earlier_steps_begins_anew(again):
    """At each step as at the first one of a round that begins there."""
    beliefs, which = again._forgotten()
    for step in range(3):
        later = replace(
            again.rounds,
            observation={name: one[:, step:] for name, one in again.rounds.observation.items()},
            told={name: one[:, step:] for name, one in again.rounds.told.items()},
            actions=again.rounds.actions[:, step:],
            real=again.rounds.real[:, step:],
        )
        wanted, place = replace(again, rounds=later)._believed(again.human, again.row, again.drawn)
        torch.testing.assert_close(beliefs[which[:, step]], wanted[place[:, 0]])


def test_statistics_are_those_by_hand(again):
    """p-values of given replicates, with ratios of single items and steps in plain loops."""
    generator = torch.Generator().manual_seed(0)
    replicates = torch.randint(2, (*again.log_probabilities.shape[:2], 7), generator=generator)
    courses = torch.cat([again.rounds.actions[again.row][..., None], replicates], -1)
    rows, begins, masks = again._events(torch.Generator())
    usual, forgotten = again.log_probabilities, again._acting(*again._forgotten(), again.drawn)
    real = again.rounds.real[again.row]
    missed = torch.zeros(2, 8, dtype=torch.double)
    forgot = torch.zeros(2, 8, dtype=torch.double)
    late = {}
    for delay in DELAYS:
        unseen = torch.zeros(len(rows), real.shape[1], 4, dtype=torch.bool)
        for event, (begin, mask) in enumerate(zip(begins.tolist(), masks["visual"], strict=True)):
            unseen[event, begin : begin + delay] = mask
        hidden = {"visual": unseen, "verbal": torch.zeros_like(unseen)}
        drawn = again.drawn[rows]
        human = missing(again.human, hidden)
        believed = again._believed(human, again.row[rows], drawn)
        late[delay] = again._acting(*believed, drawn)
    for course in range(8):
        for event, row in enumerate(rows.tolist()):
            total = 1 / 2
            for delay, weight in DELAYS.items():
                ratio = 1.0
                for step in real[row].nonzero()[:, 0].tolist():
                    action = courses[row, step, course]
                    ratio *= float((late[delay][event, step] - usual[row, step])[action].exp())
                total += weight * ratio
            missed[again.drawn[row], course] += math.log(total)
        for row in range(len(real)):
            for step in real[row].nonzero()[:, 0].tolist():
                action = courses[row, step, course]
                ratio = float((forgotten[row, step] - usual[row, step])[action].exp())
                forgot[again.drawn[row], course] += math.log(1 / 2 + ratio / 2)
    for name, values in (("missed", missed), ("forgot", forgot)):
        wanted = sum(more_often(one[None, 1:], one[None, :1]) for one in values) / 2
        given = (replicates, torch.Generator()) if name == "missed" else (replicates,)
        assert getattr(again, name)(*given) == pytest.approx(wanted)


def test_items_come_into_sight_once_until_they_are_lost(again):
    rows, begins, masks = again._events(torch.Generator())
    found = {
        (row, begin, int(mask.long().argmax()))
        for row, begin, mask in zip(rows.tolist(), begins.tolist(), masks["visual"], strict=True)
    }
    wanted = set()
    for row, (place, draw) in enumerate(zip(again.row, again.drawn, strict=True)):
        before = torch.zeros(4, dtype=torch.bool)
        for step in range(int(again.rounds.real[place].sum())):
            now = {name: one[place, step] for name, one in again.rounds.observation.items()}
            implants = {site: again.draws[site][draw, 0, 0] for site in again.sites}
            seen = again.human.sees(implants, now, step)["visual"]
            wanted |= {(row, step, int(item)) for item in (seen & ~before).nonzero()}
            before = seen
    assert found == wanted and len(wanted) > 10
    assert not masks["verbal"].any()


class Blind(HumanModel):
    """Sees nothing."""

    def sees(self, implants, observation, step):
        """Nothing."""
        masks = super().sees(implants, observation, step)
        return {name: torch.zeros_like(mask) for name, mask in masks.items()}


class Late(HumanModel):
    """Sees nothing at every other step."""

    def sees(self, implants, observation, step):
        """Nothing at even steps."""
        masks = super().sees(implants, observation, step)
        return {name: mask & (step % 2 == 1) for name, mask in masks.items()}


def test_who_misses_things_is_told_from_who_does_not(human):
    """Given their true implants, so that p-values of the model's own people are uniform."""
    found = []
    for model in (human, Late(human.self_model)):
        draws = draw_prior(model, 1, 1, 5)
        for site in sight_sites(human.domain):
            draws[site] = torch.full((1, 1, 1), 5)
        draws |= {"consistency": torch.full((1, 1, 1), 3.0), "lapse": torch.full((1, 1, 1), 0.02)}
        implants = {name: value[0] for name, value in draws.items()}
        played = play_rounds(model, implants, 20, "fog", torch.Generator().manual_seed(6))
        found.append(perception_p_values(human, played, draws, torch.Generator().manual_seed(7)))
    usual, late = found
    assert min(usual.values()) > 0.001
    assert late["missed"] < 0.001


@pytest.mark.parametrize(
    ("name", "world"),
    [("late", "driving"), ("all", "driving"), ("per-item", "driving"), ("mirror", "bomb_defusal")],
)
def test_models_of_which_perception_is_not_checked(name, world, rounds):
    model = load_human_model(name, load_self_model(shipped_weights(world))[0])
    assert perception_p_values(model, rounds, {}, torch.Generator()) == {}


class PerceivesAll(HumanModel):
    """Perceives everything, without a look."""

    def perceive(self, implants, knowledge, observation, told, step):
        """Everything."""
        return View({name: torch.ones_like(mask) for name, mask in told.items()}), knowledge


@pytest.mark.parametrize("kind", [Blind, PerceivesAll])
def test_without_items_that_come_into_sight_nothing_is_missed(again, rounds, kind):
    human = kind(again.human.self_model)
    found = perception_p_values(human, rounds, again.draws, torch.Generator().manual_seed(0))
    assert found.keys() == {"forgot"}


def test_only_small_p_values_of_perception_are_reasons():
    others = {"reward": 0.4, "surprise": 0.5}
    assert verdict(others | {"missed": 0.9999, "forgot": 1.0}, None).word == "ok"
    found = verdict(others | {"missed": 0.012, "forgot": 0.2}, None)
    assert found.word == "suspect"
    assert found.reasons == (
        "acts as if noticing late, or not at all, what the model says they see (p = 0.012)",
    )


def test_few_of_many_items_are_taken_at_random(again, monkeypatch):
    monkeypatch.setattr(perception_checks, "EVENTS", 5)
    rows, *_ = again._events(torch.Generator().manual_seed(0))
    assert len(rows) == 10

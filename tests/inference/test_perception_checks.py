"""Checks of perception against what is worked out by hand, and people who miss or forget."""

import math
from dataclasses import replace

import pytest
import torch

import mirror_ppl
from mirror_ppl.data import Demonstrations, asset_path, load_demonstrations
from mirror_ppl.inference.results import perception_checks
from mirror_ppl.inference.results.criticism import verdict
from mirror_ppl.inference.results.perception_checks import (
    DELAYS,
    PerceivedAgain,
    missing,
    perception_p_values,
)
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.likelihood.combinations import perceived_sites
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.models import HumanModel, View
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.perception import perceived_by
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights

LENGTHS = [15, 4, 9]
BINS = [[4, 6], [3, 5], [2, 6], [5, 3]]
"""Sight of two draws in each direction."""


@pytest.fixture(scope="module")
def human():
    return HumanModel(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def rounds():
    """Three rounds of different lengths, with messages."""
    recordings = load_demonstrations(asset_path("driving_fog_diverse.nc"))
    some = recordings.select_people([1]).select_rounds(range(3))
    variables, generator = some.variables(), torch.Generator().manual_seed(0)
    for name in ("told_visual", "told_verbal"):
        variables[name] = torch.rand(variables[name].shape, generator=generator) < 0.1
    variables["length"] = torch.tensor([LENGTHS])
    return Demonstrations.from_variables("driving", "fog", ["one"], variables)


@pytest.fixture
def draws(human):
    found = draw_prior(human, 1, 2, 3)
    for site, bins in zip(sight_sites(human.domain), BINS, strict=True):
        found[site] = torch.tensor(bins).view(2, 1, 1)
    return found


@pytest.fixture
def again(human, rounds, draws):
    return PerceivedAgain(human, tuple(perceived_sites(human)), rounds_of(rounds, 0), draws)


def test_rounds_are_perceived_as_in_predictions(human, rounds, again):
    predicted = predict_rounds(human, rounds, again.draws)[:, 0].flatten(0, 1)
    assert again.real.sum() == 2 * sum(LENGTHS)
    torch.testing.assert_close(again.log_probabilities[again.real], predicted[again.real])


class NotANumberLater(PerceivedAgain):
    """Beliefs after a round lead to probabilities that are not numbers."""

    def acting(self, beliefs, which, draw):
        found = super().acting(beliefs, which, draw)
        return torch.where(self.real[..., None], found, torch.nan)


def test_what_follows_a_round_does_not_matter(again):
    odd = NotANumberLater(again.human, again.sites, again.rounds, again.draws)
    given = [one.replicates(torch.Generator().manual_seed(0)) for one in (odd, again)]
    values = [one.forgot(given[0]) for one in (odd, again)]
    torch.testing.assert_close(*values)


def test_messages_are_heard_again(again):
    """Some of them change what is done."""
    silent = {name: torch.zeros_like(mask) for name, mask in again.rounds.told.items()}
    alone = replace(again, rounds=replace(again.rounds, told=silent))
    assert (again.log_probabilities - alone.log_probabilities).abs().max() > 0.1


class SeesNothing(HumanModel):
    """Sees nothing."""

    def sees(self, implants, observation, step):
        """Nothing."""
        masks = super().sees(implants, observation, step)
        return {name: torch.zeros_like(mask) for name, mask in masks.items()}


def test_who_misses_all_items_sees_nothing(again):
    """As people of a model who see nothing."""
    blind = SeesNothing(again.human.self_model)
    unseen = {name: torch.ones(*again.real.shape, 4).bool() for name in ("visual", "verbal")}
    beliefs, which = again.believed(missing(again.human, unseen), again.round, again.draw)
    wanted, place = replace(again, human=blind).believed(blind, again.round, again.draw)
    torch.testing.assert_close(beliefs[which][again.real], wanted[place][again.real])


def test_who_forgets_all_earlier_steps_begins_anew(again):
    """At each step as at the first one of a round that begins there."""
    beliefs, which = again.forgotten()
    for step in range(3):
        later = replace(
            again.rounds,
            observation={name: one[:, step:] for name, one in again.rounds.observation.items()},
            told={name: one[:, step:] for name, one in again.rounds.told.items()},
            actions=again.rounds.actions[:, step:],
            real=again.rounds.real[:, step:],
        )
        rest = replace(again, rounds=later)
        wanted, place = rest.believed(again.human, again.round, again.draw)
        torch.testing.assert_close(beliefs[which[:, step]], wanted[place[:, 0]])


def test_statistics_are_those_by_hand(again):
    """Recorded and random actions, with ratios of single items and steps in plain loops."""
    generator = torch.Generator().manual_seed(0)
    others = torch.randint(2, (*again.real.shape, 3), generator=generator)
    courses = torch.cat([again.recorded, others], -1)
    events, usual = again.events(torch.Generator()), again.log_probabilities
    missed, forgot = torch.zeros(2, 4).double(), torch.zeros(2, 4).double()
    late = {}
    for delay in DELAYS:
        unseen = torch.zeros(len(events.pair), again.real.shape[1], 4, dtype=torch.bool)
        for event, (begin, item) in enumerate(
            zip(events.step.tolist(), events.item["visual"], strict=True)
        ):
            unseen[event, begin : begin + delay] = item
        draw = again.draw[events.pair]
        without = missing(again.human, {"visual": unseen})
        late[delay] = again.acting(*again.believed(without, again.round[events.pair], draw), draw)
    forgotten = again.acting(*again.forgotten(), again.draw)

    def ratio(found, pair, step, course):
        return float((found[step] - usual[pair, step])[courses[pair, step, course]].exp())

    for course in range(4):
        for event, pair in enumerate(events.pair.tolist()):
            steps = range(LENGTHS[again.round[pair]])
            each = [
                weight * math.prod(ratio(late[delay][event], pair, step, course) for step in steps)
                for delay, weight in DELAYS.items()
            ]
            missed[again.draw[pair], course] += math.log(1 / 2 + sum(each))
        for pair in range(len(again.real)):
            for step in range(LENGTHS[again.round[pair]]):
                found = ratio(forgotten[pair], pair, step, course)
                forgot[again.draw[pair], course] += math.log(1 / 2 + found / 2)
    torch.testing.assert_close(again.missed(events)(courses), missed, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(again.forgot(courses), forgot, rtol=1e-4, atol=1e-4)
    assert missed.abs().min() > 0.1 and forgot.abs().min() > 0.1


def test_items_come_into_sight_once_until_they_are_lost(again):
    events = again.events(torch.Generator())
    items = events.item["visual"].long().argmax(-1)
    found = set(zip(events.pair.tolist(), events.step.tolist(), items.tolist(), strict=True))
    wanted = set()
    for pair, (place, draw) in enumerate(zip(again.round, again.draw, strict=True)):
        before = torch.zeros(4, dtype=torch.bool)
        for step in range(LENGTHS[place]):
            now = {name: one[place, step] for name, one in again.rounds.observation.items()}
            implants = {site: again.draws[site][draw, 0, 0] for site in again.sites}
            seen = again.human.sees(implants, now, step)["visual"]
            wanted |= {(pair, step, int(item)) for item in (seen & ~before).nonzero()}
            before = seen
    assert found == wanted and len(wanted) > 10
    assert not events.item["verbal"].any()


def test_few_of_many_items_are_taken_at_random(again, monkeypatch):
    monkeypatch.setattr(perception_checks, "EVENTS", 5)
    assert len(again.events(torch.Generator().manual_seed(0)).pair) == 10


def test_many_draws_count(human, rounds, monkeypatch):
    """From the first to the last, as many as are compared."""
    given = []

    class Noted(PerceivedAgain):
        def __init__(self, human, sites, rounds, draws):
            super().__init__(human, sites, rounds, draws)
            given.append(draws["consistency"].flatten())

    monkeypatch.setattr(perception_checks, "PerceivedAgain", Noted)
    draws = draw_prior(human, 1, 50, 0)
    perception_p_values(human, rounds, draws, torch.Generator())
    assert len(given[0].unique()) == perception_checks.DRAWS
    assert torch.equal(given[0][[0, -1]], draws["consistency"].flatten()[[0, -1]])


class SeesEveryOtherStep(HumanModel):
    """Sees nothing at even steps."""

    def sees(self, implants, observation, step):
        """Nothing at even steps."""
        masks = super().sees(implants, observation, step)
        return {name: mask & (step % 2 == 1) for name, mask in masks.items()}


def test_who_misses_things_has_a_small_p_value(human):
    """Given their true implants; of people of the model p-values are uniform."""
    found = []
    for model in (human, SeesEveryOtherStep(human.self_model)):
        draws = draw_prior(model, 1, 1, 5)
        for site in sight_sites(human.domain):
            draws[site] = torch.full((1, 1, 1), 5)
        draws |= {"consistency": torch.full((1, 1, 1), 3.0), "lapse": torch.full((1, 1, 1), 0.02)}
        implants = {name: value[0] for name, value in draws.items()}
        played = play_rounds(model, implants, 20, "fog", torch.Generator().manual_seed(6))
        found.append(perception_p_values(human, played, draws, torch.Generator().manual_seed(7)))
    usual, missed = found
    assert min(usual.values()) > 0.001
    assert missed["missed"] < 0.001


class ReadsSight(HumanModel):
    """Acts on sight itself, besides beliefs."""

    def act(self, implants, belief, values):
        """More consistent with longer sight."""
        more = 1 + implants["sight_front_own"]
        return super().act(
            implants | {"consistency": implants["consistency"] * more}, belief, values
        )


class CountsLittle(HumanModel):
    """Decisions count a half."""

    likelihood_power = 0.5


@pytest.mark.parametrize("kind", ["late", "all", "per-item", ReadsSight, CountsLittle])
def test_models_of_which_perception_is_not_checked(kind, human, rounds):
    name = isinstance(kind, str)
    model = load_human_model(kind, human.self_model) if name else kind(human.self_model)
    draws = draw_prior(model, 1, 2, 0)
    assert perception_p_values(model, rounds, draws, torch.Generator()) == {}


class PerceivesAll(HumanModel):
    """Perceives everything, without a look."""

    def perceive(self, implants, knowledge, observation, told, step):
        """Everything."""
        return View({name: torch.ones_like(mask) for name, mask in told.items()}), knowledge


@pytest.mark.parametrize("kind", [SeesNothing, PerceivesAll])
def test_without_items_that_come_into_sight_nothing_is_missed(draws, human, rounds, kind):
    model = kind(human.self_model)
    found = perception_p_values(model, rounds, draws, torch.Generator().manual_seed(0))
    assert found.keys() == {"forgot"}


class Blinks(HumanModel):
    """Looks at odd steps only."""

    def perceive(self, implants, knowledge, observation, told, step):
        """At even steps with closed eyes."""
        if step % 2:
            return super().perceive(implants, knowledge, observation, told, step)

        def closed(observation):
            return {
                name: torch.zeros_like(value[..., 0], dtype=torch.bool)
                for name, value in observation.items()
                if name != "ego"
            }

        return perceived_by(closed, self.domain, implants, knowledge, observation, told)


class OwnLook(HumanModel):
    """Has a method ``sees`` with another parameter."""

    def sees(self, implants, observation, step, near=False):
        """As everybody."""
        del near
        return super().sees(implants, observation, step)

    def perceive(self, implants, knowledge, observation, told, step):
        """After a look of its own."""
        self.sees(implants, observation=observation, step=step, near=True)
        return super().perceive(implants, knowledge, observation, told, step)


class LooksTwice(HumanModel):
    """Looks at two observations at once, one after the other in the first dimension."""

    def perceive(self, implants, knowledge, observation, told, step):
        """After such a look."""
        both = {name: torch.cat([value, value]) for name, value in observation.items()}
        self.sees({name: value.repeat(2) for name, value in implants.items()}, both, step)
        return super().perceive(implants, knowledge, observation, told, step)


class Indifferent(HumanModel):
    """Acts at random."""

    def act(self, implants, belief, values):
        """Without beliefs, one distribution for all."""
        return torch.zeros(*implants["lapse"].shape, values.shape[-1]).log_softmax(-1)


@pytest.mark.parametrize("kind", [Blinks, OwnLook, LooksTwice, Indifferent])
def test_fits_of_unusual_models_end_with_a_verdict(human, rounds, kind):
    """What a fit can do, its checks can do."""
    model = kind(human.self_model)
    draws = draw_prior(model, 1, 3, 0)
    assert predict_rounds(model, rounds, draws).isfinite().all()
    found = perception_p_values(model, rounds, draws, torch.Generator().manual_seed(0))
    assert "forgot" in found and all(0 <= value <= 1 for value in found.values())


def test_a_user_s_model_is_fitted_and_checked(human, rounds):
    fit = mirror_ppl.infer(rounds, human=Blinks, explore=0, draws=20, train_rounds=3)
    assert fit.check["nll"].dtype == float and fit.check["nll"].isna().all()  # none held out
    assert {"missed", "forgot"} <= fit.summary["people"][0]["check"]["p_values"].keys()


def test_draws_that_hold_the_record_impossible_do_not_count(human, rounds, draws):
    class Sure(HumanModel):
        def act(self, implants, belief, values):
            """Never the second action, if consistent."""
            found = super().act(implants, belief, values)
            never = (implants["consistency"] > 1)[..., None] * torch.tensor([0.0, math.inf])
            return torch.log_softmax(found - never.nan_to_num(0, math.inf), -1)

    model = Sure(human.self_model)
    draws = draws | {"consistency": torch.tensor([2.0, 3.0]).view(2, 1, 1)}
    assert perception_p_values(model, rounds, draws, torch.Generator()) == {}
    draws["consistency"][0] = 0.5
    usual = {name: value[:1] for name, value in draws.items()}
    found = [
        perception_p_values(model, rounds, one, torch.Generator().manual_seed(0))
        for one in (draws, usual)
    ]
    # Four standard errors, with 1,000 and 2,000 replicates.
    assert found[0] == pytest.approx(found[1], abs=4 * 0.5 * (1 / 1000 + 1 / 2000) ** 0.5)


def test_only_small_p_values_of_perception_are_reasons():
    others = {"reward": 0.4, "surprise": 0.5}
    assert verdict(others | {"missed": 0.9999, "forgot": 1.0}).word == "ok"
    found = verdict(others | {"missed": 0.012, "forgot": 0.2})
    assert found.word == "suspect"
    assert found.reasons == (
        "is better explained by noticing late, or missing, what the model says they see "
        "(p = 0.012)",
    )

"""Which channels reach a person: exact posteriors, and planners that find out."""

import copy
import pickle
from dataclasses import dataclass, replace
from itertools import product

import pytest
import torch
from example_course import gone_through
from torch import Tensor

from mirror_ppl.communication import Person, RoundSoFar
from mirror_ppl.communication.hearing import HearingPerson, hearing
from mirror_ppl.communication.planners import PlannerOptions, planner_of
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.errors import InputError
from mirror_ppl.evaluation.assistance import (
    Listener,
    Planning,
    listeners,
    play,
    play_together,
    speaker,
)
from mirror_ppl.models import HumanModel
from mirror_ppl.models.family import HardOfHearing
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate, simulated_people
from mirror_ppl.people.of_human_model import PeopleOfHumanModel


@pytest.fixture(scope="module")
def driving():
    return HumanModel(load_self_model(shipped_weights("driving"), "driving")[0])


def nearly_blind(human, number):
    draws = draw_prior(human, 1, number, 1)
    return draws | {site: torch.zeros_like(draws[site]) for site in sight_sites(human.domain)}


def told_round(domain="driving"):
    """A recorded round in which things were told at random, and its first steps as planning has
    them."""
    rounds = simulate(domain, None, "paper", 1, 1, 100, told=0.2)
    return rounds, RoundSoFar.of(rounds, "person-01", 0, 8)


def test_channels_that_reach_a_person_are_inferred_exactly(driving):
    """By Bayes's rule, with the likelihood of each pattern by going through the program."""
    draws = nearly_blind(driving, 5)
    rounds, past = told_round()
    person = HearingPerson(driving, draws, 0.8)
    found = person._after(past).softmax(-1)
    human = HardOfHearing(driving.self_model)
    observation = {name: value[0, 0, :8] for name, value in rounds.observation().items()}
    told = {name: mask[0, 0, :8] for name, mask in rounds.told.items()}
    expected = torch.zeros(5, 4)
    for draw in range(5):
        own = {name: value[draw, 0, 0] for name, value in draws.items()}
        for place, pattern in enumerate(product((0, 1), repeat=2)):
            hears = dict(
                zip(("hears_visual", "hears_verbal"), map(torch.tensor, pattern), strict=True)
            )
            belief = gone_through(human, own | hears, observation, told, rounds.actions[0, 0, :8])
            implants = {name: value[draw] for name, value in draws.items()}
            belief = belief.view(1, 8, -1)
            probabilities = driving.act(implants, belief, driving.action_values(belief))
            done = probabilities.view(8, 2)[torch.arange(8), rounds.actions[0, 0, :8]].sum()
            prior = torch.tensor([0.2, 0.8])[list(pattern)].log().sum()
            expected[draw, place] = done + prior
    torch.testing.assert_close(found, expected.softmax(-1), atol=1e-4, rtol=1e-3)
    assert (found[:, 3] - 0.64).abs().max() > 0.05  # it was worth inferring


def test_shares_of_a_posterior_are_those_of_subsets_of_channels(driving):
    """Half of the draws hear both, the others neither; the prior counts as one more draw."""
    human = HardOfHearing(driving.self_model)
    draws = draw_prior(human, 1, 8, 1)
    half = torch.tensor([0, 1]).repeat(4).view(8, 1, 1)
    person = HearingPerson(human, draws | {"hears_visual": half, "hears_verbal": half}, 0.9)
    expected = torch.tensor([4 + 0.01, 0.09, 0.09, 4 + 0.81]) / 9
    torch.testing.assert_close(person.log_hears.exp(), expected.expand(8, -1))


def test_planners_can_be_pickled(driving):
    planner = planner_of("mirror", Person(driving, nearly_blind(driving, 8)), PlannerOptions(), 3)
    _, past = told_round()
    expected = planner.plan(past)
    for copied in (pickle.loads(pickle.dumps(planner)), copy.deepcopy(planner)):
        assert copied.plan(past).gain == expected.gain
        assert type(copied.person.human).__mro__[1] is HardOfHearing


def test_the_oracle_knows_who_does_not_hear(driving):
    kind = HardOfHearing(driving.self_model)
    draws = {name: value[0] for name, value in draw_prior(kind, 1, 1, 1).items()}
    deaf = {name: torch.zeros_like(draws[name]) for name in ("hears_visual", "hears_verbal")}
    people = PeopleOfHumanModel(kind, draws | deaf)
    one = listeners(people, 1, "fog", 3, 100)[0]
    oracle = speaker("oracle", one, PlannerOptions(horizon=4), 1)
    assert isinstance(oracle, Planning) and oracle.hears == {}
    assert not any(bool(oracle.planner.person.draws[name].any()) for name in deaf)
    assert play(one, oracle).cost == [0, 0, 0]


def test_rounds_add_up(driving):
    """After a round, and so far in the next, is as if both were said at once."""
    person = HearingPerson(driving, nearly_blind(driving, 5), 0.8)
    _, past = told_round()
    once, twice = person.after(past), person.after(past).after(past)
    gained = [one.log_hears - person.log_hears for one in (once, twice)]
    same = [value - value[:, :1] for value in gained]
    torch.testing.assert_close(2 * same[0], same[1], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(once._after(past), twice.log_hears)
    assert person.hears == pytest.approx({"visual": 0.8, "verbal": 0.8})


def test_without_messages_nothing_is_learned_of_them(driving):
    person = HearingPerson(driving, nearly_blind(driving, 5), 0.8)
    rounds = load_demonstrations(asset_path("driving_fog_paper.nc"))
    past = RoundSoFar.of(rounds, "person-01", 0, 8)
    assert person.after(past).log_hears is person.log_hears


def test_draws_are_as_often_of_each_pattern_as_it_is_probable(driving):
    """Systematically: of 40 draws 36 hear of a channel that reaches people with .9."""
    person = HearingPerson(driving, nearly_blind(driving, 40), 0.9)
    verbal = person.draws["hears_verbal"].flatten()
    both = (verbal == 1) & (person.draws["hears_visual"].flatten() == 1)
    assert int(both.sum()) in (32, 33)  # .81 of 40
    assert int(verbal.sum()) in (35, 36, 37)


def test_for_certain_everybody_is_as_they_were(driving):
    person = Person(driving, nearly_blind(driving, 5))
    assert hearing(person, 1.0) is person
    open_to = hearing(person, 0.9)
    assert isinstance(open_to, HearingPerson) and hearing(open_to, 0.5) is open_to
    assert open_to.human is not driving and type(driving) is HumanModel
    for wrong in (0.0, -1.0, 1.5, float("nan")):
        with pytest.raises(InputError, match="hears must be"):
            PlannerOptions(hears=wrong)


def test_a_model_that_infers_it_is_taken_at_its_word(driving):
    """With one draw more by the prior, so that nothing is ruled out."""
    human = HardOfHearing(driving.self_model)
    draws = nearly_blind(human, 9)
    draws |= {"hears_visual": torch.zeros(9, 1, 1, dtype=torch.long)}
    draws |= {"hears_verbal": torch.ones(9, 1, 1, dtype=torch.long)}
    found = hearing(Person(human, draws), 0.5)
    assert isinstance(found, HearingPerson) and found.human is human
    assert found.hears == pytest.approx({"visual": 0.05, "verbal": 0.95})


@dataclass(frozen=True)
class Deaf:
    """A simulated person whom no message reaches."""

    driver: object

    def __getattr__(self, name):
        return getattr(self.driver, name)

    def step(self, memory, observation, told):
        nothing = {name: torch.zeros_like(mask) for name, mask in told.items()}
        return self.driver.step(memory, observation, nothing)  # pyright: ignore


def test_who_does_not_react_is_soon_left_in_peace(driving):
    """Five rounds of one driver: who hears loses nothing, and who does not a third of the cost."""
    everybody = simulated_people("driving", "fog", "paper", 1, 100)
    (alone,) = listeners(everybody, 1, "fog", 5, 100)
    draws = {name: torch.as_tensor(value) for name, value in known(driving, everybody).items()}
    alone = replace(alone, person=Person(driving, draws))

    def played(listener: Listener, hears: float):
        options = PlannerOptions.of("driving", hears=hears)
        return play(listener, speaker("mirror", listener, options, 1))

    deaf = replace(alone, driver=Deaf(alone.driver))
    found = played(deaf, 0.9)
    assert 0 < sum(found.cost) < 0.7 * sum(played(deaf, 1.0).cost)
    assert all(chance < 0.2 for chance in found.hears.values())
    assert sum(found.cost[:2]) > sum(found.cost[3:])
    heard = played(alone, 0.9)
    silent = play(alone, speaker("none", alone, PlannerOptions(), 1))
    assert heard.net.sum() - silent.net.sum() > 10
    assert heard.hears["verbal"] > 0.9


def test_planners_of_several_people_keep_apart_what_each_hears(driving):
    everybody = simulated_people("driving", "fog", "diverse", 2, 100)
    people = [
        replace(one, person=Person(driving, known(driving, one.driver)))
        for one in listeners(everybody, 2, "fog", 2, 100)
    ]
    options = PlannerOptions.of("driving", hears=0.7, horizon=4)
    together = play_together(people, [speaker("mirror", one, options, 1) for one in people])
    for found, one in zip(together, people, strict=True):
        alone = play(one, speaker("mirror", one, options, 1))
        assert (found.task, found.cost, found.items) == (alone.task, alone.cost, alone.items)
        assert found.hears == pytest.approx(alone.hears, abs=1e-6)
    assert together[0].hears != together[1].hears


def known(human, people) -> dict[str, Tensor]:
    """Draws that see what the person sees."""
    draws = draw_prior(human, 1, 16, 1)
    bins = torch.tensor(human.domain.reach_bins)
    for site, value in people.truth().items():
        if site in draws:
            known = (bins == value[0]).long().argmax() if site.startswith("sight") else value[0]
            draws[site] = torch.full_like(draws[site], float(known))
    return draws


def test_after_a_round_the_planner_is_that_of_the_next(driving):
    planner = planner_of("mirror", Person(driving, nearly_blind(driving, 8)), PlannerOptions(), 3)
    _, past = told_round()
    later = planner.after(past)
    assert isinstance(planner.person, HearingPerson) and isinstance(later.person, HearingPerson)
    assert later.person.hears != planner.person.hears
    assert (later.objective, later.seed) == (planner.objective, planner.seed)
    with pytest.raises(InputError, match="the round must be"):
        planner.after("a round")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("world", ["search_rescue", "bomb_defusal"])
def test_it_is_found_out_in_all_worlds(world):
    """Also where attention differs from round to round."""
    human = load_human_model(None, load_self_model(shipped_weights(world), world)[0])
    draws = draw_prior(human, 1, 4, 1)
    person = HearingPerson(human, draws, 0.9)
    rounds = simulate(world, None, "paper", 1, 1, 100, told=0.2)
    past = RoundSoFar.of(rounds, "person-01", 0, 10)
    found = person._after(past)
    assert found.shape == (4, 4) and bool(found.isfinite().all())
    assert not torch.allclose(found, person.log_hears, atol=1e-3)
    # In the round, each draw hears what was drawn for it by these probabilities.
    drawn = person.in_round(past).draws
    for site, own in person._drawn(found).items():
        assert torch.equal(drawn[site], own)

"""A posterior that is kept up to date: the same as one of all rounds at once."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_person import Averaging
from few_reaches import robot_of_few_reaches

from mirror_ppl.communication import Person
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.online import OnlinePosterior
from mirror_ppl.likelihood.view_table_builder import FEW_ROUNDS
from mirror_ppl.models import HumanModel
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.toy import ToyHuman
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.guide_file import load_guide, shipped_guide


@pytest.fixture(scope="module")
def human():
    return HumanModel(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def network(human):
    return load_guide(shipped_guide("driving"), human)[0]


@pytest.fixture(scope="module")
def rounds():
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return recordings.select_people([0]).select_rounds(range(4))


@pytest.fixture(scope="module")
def few_reaches():
    return HumanModel(robot_of_few_reaches())


class AmongOthers(ToyHuman):
    """A density that is no sum over people."""

    def prior(self):
        found = super().prior()
        rate = found["in_sight"]
        pyro.factor("sum", 20 * rate.log().mean() * torch.ones_like(rate))
        return found


def test_models_that_break_their_contract_are_refused(human):
    with pytest.raises(HumanModelError, match='the log density of "sum"'):
        OnlinePosterior(AmongOthers(human.self_model))


@pytest.fixture(params=["amortized", "importance"])
def asked(request, human, few_reaches, network, rounds):
    """Two posteriors: of so many rounds one by one, and of all at once.

    With the network, of the model that it is for; without, of one with fewer reaches.
    """

    def of(number):
        given = (human, network) if request.param == "amortized" else (few_reaches,)
        little, whole = OnlinePosterior(*given), OnlinePosterior(*given)
        for one in range(number):
            little.add(rounds.select_rounds([one]))
        whole.add(rounds.select_rounds(range(number)))
        return little, whole

    return of


def test_round_by_round_is_the_same_as_all_at_once(human, asked):
    little, whole = asked(FEW_ROUNDS)
    one, other = little.draws(40), whole.draws(40)
    assert all(torch.equal(one[name], other[name]) for name in other)
    assert little.rounds == whole.rounds == FEW_ROUNDS
    assert -1 < little.pareto_k < 0.7 and min(little.seconds) > 0
    assert little.effective_draws >= 64
    assert Person(human, one).number == 40


def test_the_order_in_which_rounds_are_gone_through_makes_no_difference(human, asked):
    """More rounds are gone through in an order of their own, which gives up others.

    Effective draws are 110 or more, so a probability's standard deviation is at most .05 in each.
    """
    one, other = (posterior.draws(1000) for posterior in asked(FEW_ROUNDS + 2))
    for site in sight_sites(human.domain):
        for value in range(7):
            share = [float((own[site] == value).float().mean()) for own in (one, other)]
            assert abs(share[0] - share[1]) < 4 * math.hypot(0.05, 0.05)


def test_it_agrees_with_the_fit(human, network, rounds):
    """Effective draws are 110 and 400 or more, so a probability's s.d. is at most .05 and .03."""
    online = OnlinePosterior(human, network)
    online.add(rounds)
    draws = online.draws(1000)
    fitted = infer(human, rounds, InferenceOptions(draws=1000), 1).draws
    for site in sight_sites(human.domain):
        for value in range(7):
            share = [float((own[site] == value).float().mean()) for own in (draws, fitted)]
            assert abs(share[0] - share[1]) < 4 * math.hypot(0.05, 0.03)


def test_what_is_known_before_the_first_round_is_the_prior(human, network, rounds):
    online = OnlinePosterior(human, network)
    with pytest.raises(ValueError, match="no round yet; what is known is the prior"):
        online.draws()
    online.add(rounds.select_rounds([]))
    assert online.rounds == 0


@pytest.mark.parametrize("kind", [HumanModel, Averaging])
def test_rounds_may_be_of_different_lengths(human, rounds, kind):
    """As if the shorter one had been padded to the length of the others."""
    own = kind(human.self_model)
    variables = rounds.variables()
    variables["length"] = torch.tensor([[15, 7, 15, 15]])
    padded = type(rounds).from_variables("driving", "fog", rounds.people, variables)
    found = []
    for parts in ([padded.select_rounds([n]) for n in range(3)], [padded.select_rounds(range(3))]):
        online = OnlinePosterior(own)
        for part in parts:
            online.add(part)
        found.append(online.draws(30))
    assert parts[0].shape[2] == 15 and padded.select_rounds([1]).shape[2] == 7
    for name, value in found[1].items():
        torch.testing.assert_close(found[0][name], value)


def test_asking_leaves_the_random_state_alone(human, network, rounds):
    online = OnlinePosterior(human, network)
    before = torch.random.get_rng_state()
    online.add(rounds.select_rounds([0]))
    online.draws(5)
    infer(human, rounds.select_rounds([0]), InferenceOptions(draws=5), 0)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_people_are_not_mixed(human, network):
    two = load_demonstrations(asset_path("driving_fog_paper.nc")).select_people([0, 1])
    with pytest.raises(ValueError, match="of 2 people, not one"):
        OnlinePosterior(human, network).add(two)


def test_the_rounds_of_another_person_are_refused(human):
    two = load_demonstrations(asset_path("driving_fog_paper.nc")).select_rounds([0])
    online = OnlinePosterior(human)
    online.add(two.select_people([0]))
    with pytest.raises(ValueError, match="rounds are of 'person-02', those before of 'person-01'"):
        online.add(two.select_people([1]))


def test_a_network_of_another_model_is_refused(human, network):
    other = Averaging(human.self_model)
    OnlinePosterior(other, network)  # whose implants are the same
    toy = ToyHuman(human.self_model)
    for given in (toy, LatePrior(human.self_model)):
        with pytest.raises(ValueError, match="the network is for another human model than"):
            OnlinePosterior(given, network)


class LatePrior(HumanModel):
    def prior(self):
        return super().prior() | {"late": pyro.sample("late", dist.Beta(1.0, 4.0))}


def test_it_says_of_whom_it_is(human, rounds):
    online = OnlinePosterior(human)
    name = type(human).__name__
    assert repr(online) == f"<OnlinePosterior of nobody yet: {name}, rounds 0>"
    online.add(rounds)
    of = f"<OnlinePosterior of {rounds.people[0]}: {name}, rounds {online.rounds}"
    assert repr(online) == of + ">"
    online.draws(4)
    assert repr(online) == f"{of}, effective draws {online.effective_draws:.0f}>"

"""What is open after a fit: against conditionals by hand, and rounds whose answer is known."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from few_reaches import robot_of_few_reaches

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.calibration.study import prior_people
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.population.pooling import Population
from mirror_ppl.inference.results.identifiability import (
    NEGLIGIBLE,
    POLICIES,
    _entropy_and_shared,
    identify,
)
from mirror_ppl.models import HumanModel
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.toy import RATES, ToyHuman
from mirror_ppl.models.variants import NoImplants
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.plots.identifiability import plot_identifiability


@pytest.fixture(scope="module")
def toy():
    return ToyHuman(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def rounds(toy):
    generator = torch.Generator().manual_seed(0)
    return play_rounds(toy, prior_people(toy, 3, generator), 2, "fog", generator)


@pytest.fixture(scope="module")
def draws(toy, rounds):
    return infer(toy, rounds, InferenceOptions(draws=POLICIES), 0).draws


def conditionals(toy, rounds, draws, person):
    """``p(reach | rates, actions)`` ``[S, n]`` of a toy person, from counts of its actions."""
    domain, steps = toy.domain, rounds.shape[2]
    observation = {name: value[:, :, :steps] for name, value in rounds.observation().items()}
    _, distance = domain.distance(observation)
    bins = torch.tensor(domain.reach_bins)
    seen = distance[person].amin(-1)[..., None] <= bins  # [B, T, n]
    one, other = (draws[site][:, person, 0, None, None, None] for site in RATES)
    rate = torch.where(seen, one, other)
    second = (rounds.actions[person] == 1)[..., None]
    likelihood = torch.where(second, rate, 1 - rate).log().sum((1, 2))
    some = torch.isin(torch.arange(len(bins)), draws["reach"][:, person, 0])
    return torch.softmax(likelihood.masked_fill(~some, -math.inf), -1)


def entropy(probability):
    return torch.special.entr(probability).sum(-1)


def test_entropies_by_hand():
    half = torch.full((4, 2), 0.5)
    assert [float(v) for v in _entropy_and_shared(half)] == pytest.approx([math.log(2), 0])
    sure = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    assert [float(v) for v in _entropy_and_shared(sure)] == pytest.approx([math.log(2)] * 2)


def test_posterior_entropy_is_that_of_the_exact_conditionals(toy, rounds, draws):
    found = identify(toy, rounds, draws, 0, rounds=0)
    assert found.sites == ("reach",)
    assert found.information.shape == found.information_error.shape == (3, 0)
    for person in range(3):
        exact = conditionals(toy, rounds, draws, person)
        total = entropy(exact.mean(0))
        hanging = total - entropy(exact).mean()
        torch.testing.assert_close(found.entropy[person, 0], total, rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(found.shared[person, 0], hanging, rtol=1e-2, atol=1e-4)
    assert (found.shared <= found.entropy).all() and found.shared.max() > 0.003
    torch.testing.assert_close(found.all_entropy, found.entropy[:, 0])
    torch.testing.assert_close(found.all_shared, found.shared[:, 0])


def test_a_population_takes_the_place_of_the_prior(toy, rounds, draws):
    probabilities = torch.arange(1.0, 8) / 28
    known = Population(
        {"reach": probabilities[None]}, *({rate: torch.ones(1) for rate in RATES} for _ in range(2))
    )
    found = identify(toy, rounds, draws, 0, known, rounds=0)
    for person in range(3):
        exact = conditionals(toy, rounds, draws, person) * probabilities
        exact = exact / exact.sum(-1, keepdim=True)
        expected = entropy(exact.mean(0))
        torch.testing.assert_close(found.entropy[person, 0], expected, rtol=1e-3, atol=1e-4)


def test_what_the_prior_rules_out_has_no_entropy(toy, rounds):
    """Also when its probabilities in a population are given for the other values alone."""

    class Short(ToyHuman):
        def prior(self):
            probabilities = torch.tensor([0.0, 0.0, 0.5, 0.5, 0.0, 0.0, 0.0])
            reach = pyro.sample("reach", dist.Categorical(probabilities))
            one = torch.ones(())
            rates = {rate: pyro.sample(rate, dist.Beta(one, one)) for rate in RATES}
            return {"reach": reach} | rates

    human = Short(toy.self_model)
    nobody = rounds.select_people([0]).select_rounds([])
    draws = infer(human, nobody, InferenceOptions(draws=POLICIES), 0).draws
    draws["reach"] = torch.arange(POLICIES).remainder(7)[:, None, None]  # all are looked at
    probabilities = {"reach": torch.tensor([[0.9, 0.1]])}
    known = Population(probabilities, *({rate: torch.ones(1) for rate in RATES} for _ in range(2)))
    found = identify(human, nobody, draws, 0, known, rounds=0)
    expected = entropy(torch.tensor([0.9, 0.1]))
    torch.testing.assert_close(found.all_entropy[0], expected, rtol=1e-3, atol=1e-4)


def two_reaches(rates):
    """Draws of one person who sees one or eight cells, as likely, and has known rates."""
    reach = torch.tensor([1, 4]).repeat(POLICIES // 2)[:, None, None]
    return {"reach": reach} | {
        site: torch.full((POLICIES, 1, 1), rate) for site, rate in zip(RATES, rates, strict=True)
    }


def test_rounds_are_as_informative_as_they_should_be(toy, rounds):
    nobody = rounds.select_people([0]).select_rounds([])
    # Both rates alike: what they do has nothing to do with what they see.
    found = identify(toy, nobody, two_reaches((0.3, 0.3)), 0, rounds=2)
    assert found.all_entropy[0] == pytest.approx(math.log(2), rel=1e-4)
    assert found.information.abs().max() < 1e-4
    # Rates that give them away wherever something is between the two reaches.
    found = identify(toy, nobody, two_reaches((0.99, 0.01)), 0, rounds=4)
    assert found.information.shape == (1, 8)
    assert found.information.max() > 0.9 * math.log(2)
    assert found.information.max() <= math.log(2) + 1e-4
    # The posterior of a person who is fully known has no entropy.
    known = two_reaches((0.99, 0.01)) | {"reach": torch.full((POLICIES, 1, 1), 4)}
    found = identify(toy, nobody, known, 0, rounds=2)
    assert found.entropy.max() == 0
    assert found.information.abs().max() < 1e-6


def test_expected_information_is_that_of_the_toy(toy, rounds):
    """Against rounds played by toys directly, whose posterior is two likelihoods."""
    rates = (0.6, 0.3)
    nobody, number = rounds.select_people([0]).select_rounds([]), 60
    found = identify(toy, nobody, two_reaches(rates), 0, rounds=number)
    generator = torch.Generator().manual_seed(1)
    scenario = torch.full((400,), 7)
    one = {"reach": torch.tensor([[1], [4]]).repeat(200, 1)}
    one |= {site: torch.full((400, 1), rate) for site, rate in zip(RATES, rates, strict=True)}
    played = play_rounds(toy, one, 1, "fog", generator, scenario)
    same = {name: value[:1].expand(2, 400, 1) for name, value in one.items() if name != "reach"}
    same["reach"] = torch.tensor([1, 4])[:, None, None].expand(2, 400, 1)
    exact = torch.stack([conditionals(toy, played, same, person)[0] for person in range(400)])
    gain = math.log(2) - entropy(exact)
    error = math.hypot(float(found.information_error[0, 7]), float(gain.std()) / 20)
    assert abs(float(found.information[0, 7]) - float(gain.mean())) < 4 * error
    assert 0.02 < gain.mean() < 0.6


def test_wide_posteriors_are_looked_at_as_a_whole(toy, rounds):
    """The posterior entropy of a person without rounds is the prior's, however few the draws."""
    human = HumanModel(toy.self_model)
    nobody = rounds.select_people([0]).select_rounds([])
    draws = infer(human, nobody, InferenceOptions(draws=100), 0).draws
    found = identify(human, nobody, draws, 0, rounds=1)
    sevens, twos = found.entropy[0, :4], found.entropy[0, 4:]
    torch.testing.assert_close(sevens, torch.full((4,), math.log(7)), rtol=1e-3, atol=0)
    torch.testing.assert_close(twos, torch.full((2,), math.log(2)), rtol=1e-3, atol=0)
    assert float(found.all_entropy[0]) == pytest.approx(math.log(9604), rel=1e-3)
    # Of one round there is no standard error.
    assert found.information_error.isnan().all()
    told = found.of(0, human.domain.scenarios)["scenarios"]
    assert all(one["error"] is None and one["expected"] > 0 for one in told.values())


def test_few_draws_do_not_make_a_posterior_narrow(toy, rounds):
    human = HumanModel(toy.self_model)
    nobody = rounds.select_people([0]).select_rounds([])
    draws = infer(human, nobody, InferenceOptions(draws=20), 0).draws
    found = identify(human, nobody, draws, 0, rounds=0)
    assert float(found.all_entropy[0]) == pytest.approx(math.log(9604), rel=1e-3)


def test_probable_combinations_are_all_that_matters(rounds):
    human = HumanModel(robot_of_few_reaches())
    one = rounds.select_people([0])
    posterior = infer(human, one, InferenceOptions(draws=POLICIES), 0)
    (probable,) = posterior.combinations
    assert 64 < len(probable) < 324
    found, known = (
        identify(human, one, posterior.draws, 0, combinations=some, rounds=0)
        for some in ((), posterior.combinations)
    )
    before = torch.random.get_rng_state()
    identify(human, one, posterior.draws, 0, combinations=posterior.combinations, rounds=1)
    assert torch.equal(torch.random.get_rng_state(), before)
    for name in ("entropy", "shared", "all_entropy", "all_shared"):
        torch.testing.assert_close(
            getattr(known, name), getattr(found, name), rtol=0, atol=NEGLIGIBLE
        )


def test_the_population_shares_no_information_with_the_policy(toy, rounds):
    """Without a round sight and policy are independent, however populations differ."""
    nobody = rounds.select_people([0]).select_rounds([])
    draws = infer(toy, nobody, InferenceOptions(draws=POLICIES), 0).draws
    probabilities = torch.distributions.Dirichlet(torch.ones(7)).sample(torch.Size([POLICIES]))
    rates = ({rate: torch.ones(POLICIES) for rate in RATES} for _ in range(2))
    found = identify(toy, nobody, draws, 0, Population({"reach": probabilities}, *rates), rounds=0)
    assert float(found.all_shared[0]) < 1e-5
    expected = entropy(probabilities.mean(0))
    torch.testing.assert_close(found.all_entropy[0], expected, rtol=1e-3, atol=1e-4)


def test_models_without_anything_to_see_have_no_report(toy, rounds):
    human = NoImplants(toy.self_model)
    draws = infer(human, rounds, InferenceOptions(draws=4), 0).draws
    assert identify(human, rounds, draws, 0) is None


def test_ten_rounds_leave_less_entropy_than_one(toy):
    human = HumanModel(toy.self_model)
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc")).select_people([1])
    found = []
    for number in (1, 10):
        train = recordings.select_rounds(range(number))
        draws = infer(human, train, InferenceOptions(draws=100), 0).draws
        found.append(identify(human, train, draws, 0, rounds=1))
    assert found[0].all_entropy > found[1].all_entropy + 1
    assert (found[0].all_shared <= found[0].all_entropy).all()
    told = found[1].of(0, human.domain.scenarios)
    assert list(told["scenarios"]) == list(human.domain.scenarios)
    assert (
        told["entropy"].keys() == told["shared_with_policy"].keys() == {*found[1].sites, "together"}
    )


@pytest.mark.parametrize("explored", [0, 2])
def test_the_picture(toy, rounds, draws, explored, tmp_path):
    from mirror_ppl.arviz import az
    from mirror_ppl.inference.results.export import add_identifiability

    found = identify(toy, rounds, draws, 0, rounds=explored)
    data = az.from_dict(
        posterior={"reach": draws["reach"][None, ..., 0].numpy()},
        dims={"reach": ["person"]},
        coords={"person": list(rounds.people)},
    )
    add_identifiability(data, found, {"domain": "driving"})
    assert data["identifiability"]["entropy"].dims == ("person", "site")
    figure = plot_identifiability(data)
    assert len(figure.axes) == 1 + bool(explored)
    bars = [patch.get_width() for patch in figure.axes[0].patches]
    assert bars[:3] == pytest.approx(found.entropy[:, 0].tolist())
    figure.save(tmp_path / "identifiability.png")

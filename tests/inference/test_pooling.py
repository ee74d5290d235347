"""Partial pooling: weights by hand, and people who are alike."""

import pyro
import pytest
import torch
from pyro import poutine
from pyro.distributions import OneHotCategorical
from scipy import stats
from torch.distributions import Beta, Normal

from mirror_ppl.inference.calibration.study import prior_people
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.population.pooling import (
    CONCENTRATION_WIDTH,
    SPREAD,
    SPREAD_WIDTH,
    Pooling,
    Population,
)
from mirror_ppl.inference.population.sampler import ContinuousSites, DiscreteSite, HyperPriors
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior, sample_sites
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.toy import RATES, ToyHuman
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def toy():
    return ToyHuman(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def pooling(toy):
    return Pooling(toy)


@pytest.fixture(scope="module")
def draws(toy):
    """Draws ``[5, 3, 1]`` of three people."""
    generator = torch.Generator().manual_seed(0)
    one = prior_people(toy, 15, generator)
    return {name: value.view(5, 3, 1) for name, value in one.items()}


def by_rate(in_sight, otherwise):
    return {"in_sight": torch.tensor(in_sight), "otherwise": torch.tensor(otherwise)}


def population(mean, spread, number):
    """A population that is known exactly."""
    probabilities = {"reach": torch.arange(1.0, 8) / 28}
    one = Population(
        *({n: v[None] for n, v in part.items()} for part in (probabilities, mean, spread))
    )
    return one.spaced(number)


def test_densities_by_hand(pooling, draws):
    known, place, log_prior = pooling.read(draws)
    assert list(place) == list(RATES) and list(known) == ["reach"]
    assert {value.shape for value in (*place.values(), log_prior)} == {(3, 5)}
    assert torch.equal(known["reach"].argmax(-1), draws["reach"][..., 0].T)
    assert (known["reach"].sum(-1) == 1).all()
    probabilities = {"reach": torch.arange(1.0, 8) / 28}
    mean, spread = by_rate(0.5, -1.0), by_rate(0.7, 0.4)
    found = pooling.log_density(probabilities, mean, spread, known, place)
    for person in range(3):
        for draw in range(5):
            reach = int(draws["reach"][draw, person])
            prior, density = -torch.tensor(7.0).log(), torch.tensor((reach + 1) / 28).log()
            for site, (one, two) in RATES.items():
                rate = draws[site][draw, person, 0]
                logit = torch.logit(rate)
                # d rate / d logit = rate (1 - rate)
                prior = prior + Beta(one, two).log_prob(rate) + (rate * (1 - rate)).log()
                density = density + Normal(mean[site], spread[site]).log_prob(logit)
            torch.testing.assert_close(log_prior[person, draw], prior, rtol=1e-4, atol=1e-4)
            torch.testing.assert_close(found[person, draw], density, rtol=1e-4, atol=1e-4)


def test_the_program_weighs_people_by_the_mean_of_ratios(pooling, draws):
    known, place, log_prior = pooling.read(draws)
    trace = pyro.poutine.trace(pooling.program).get_trace(known, place, log_prior)
    mean, spread = (
        {site: trace.nodes[f"{site}_{name}"]["value"] for site in RATES}
        for name in ("mean", "spread")
    )
    probabilities = {"reach": trace.nodes["reach_probabilities"]["value"]}
    density = pooling.log_density(probabilities, mean, spread, known, place)
    trace.compute_log_prob()
    expected = (density - log_prior).exp().mean(-1).log()
    torch.testing.assert_close(trace.nodes["rounds"]["log_prob"], expected)


def test_the_sampler_s_densities_are_those_of_the_program(pooling, draws):
    """By Bayes' rule, whatever the population: its joint density is what is drawn, site by site."""
    one = {name: value[:1] for name, value in draws.items()}  # it is known what people are like
    known, place, log_prior = pooling.read(one)
    values = torch.stack([place[name][:, 0] for name in RATES], -1)
    values = ((values - pooling.centre) / pooling.width).double()
    priors = HyperPriors(pooling.prior_probabilities, CONCENTRATION_WIDTH, SPREAD, SPREAD_WIDTH)
    continuous = ContinuousSites(3, priors, values)
    discrete = DiscreteSite(3, pooling.prior_probabilities["reach"].double(), CONCENTRATION_WIDTH)
    count = known["reach"][:, 0].sum(0).double()
    generator, offsets = torch.Generator().manual_seed(0), []
    for _ in range(20):
        cells = torch.randint(200, 440, (3,), generator=generator).tolist()
        logs = continuous.grid[cells[:2]]
        mean = torch.randn(2, generator=generator).double()
        probabilities = torch.rand(7, generator=generator).double() + 0.05
        probabilities = probabilities / probabilities.sum()
        concentration = discrete.grid[cells[2]].exp()
        population = {"reach_concentration": concentration, "reach_probabilities": probabilities}
        for column, name in enumerate(RATES):
            centre, width = pooling.centre[column], pooling.width[column]
            population[f"{name}_mean"] = centre + width * mean[column]
            population[f"{name}_spread"] = width * logs[column].exp()
        population = {name: value.float() for name, value in population.items()}
        conditioned = pyro.condition(pooling.program, data=population)
        trace = pyro.poutine.trace(conditioned).get_trace(known, place, log_prior)
        joint = float(trace.log_prob_sum())
        own = continuous.log_densities(values)[[0, 1], cells[:2]] - logs  # of spreads, not logs
        own = own + continuous.mean(values, logs.exp()).log_prob(mean)
        other = discrete.log_densities(count)[cells[2]] - concentration.log()
        other = other + discrete.probabilities(count, concentration).log_prob(probabilities)
        offsets.append(joint - float(own.sum() + other))
    assert max(offsets) - min(offsets) < 2e-3 * max(map(abs, offsets))


def test_sites_that_depend_on_others_keep_their_prior():
    """How soon each terminal is noticed follows how quick somebody is, in a population, too."""
    human = load_human_model(None, load_self_model(shipped_weights("bomb_defusal"))[0])
    pooling = Pooling(human)
    assert list(pooling.sites) == ["notice_mean", "notice_concentration", "consistency", "lapse"]
    # Which rules hold is known of the world, and better by the day; it is not about people.
    assert list(pooling.supports) == ["reads_type"]
    number = 2000
    mean = {
        name: place.expand(1) for name, place in zip(pooling.sites, pooling.centre, strict=True)
    }
    spread = {name: torch.full((1,), 0.01) for name in pooling.sites}
    mean["notice_mean"] = torch.tensor([0.05]).logit()
    probabilities = {name: prior[None] for name, prior in pooling.prior_probabilities.items()}
    new = pooling.newcomers(Population(probabilities, mean, spread).spaced(number), 1, 0)
    notice_mean, notices = new["notice_mean"], new["notices_terminal 3"]
    assert notice_mean.mean() == pytest.approx(0.05, abs=0.002)
    # Beta with this mean, and a concentration of about 100 or more.
    assert notices.mean() == pytest.approx(0.05, abs=4.5 * 0.03 / number**0.5)


def test_people_are_drawn_by_their_weights(pooling, draws):
    known, place, log_prior = pooling.read(draws)
    probabilities, number = {"reach": torch.arange(1.0, 8) / 28}, 4000
    mean, spread = by_rate(0.5, -1.0), by_rate(0.7, 0.9)
    found = pooling.pooled(draws, population(mean, spread, number), 0)
    pooled = found.draws
    weights = torch.softmax(
        pooling.log_density(probabilities, mean, spread, known, place) - log_prior, -1
    )
    torch.testing.assert_close(found.effective, 1 / weights.square().sum(-1), rtol=1e-3, atol=0)
    for person in range(3):
        same = pooled["in_sight"][:, person, 0, None] == draws["in_sight"][:, person, 0]
        counts = same.sum(0).numpy()
        assert counts.sum() == number
        expected = number * torch.softmax(weights[person].double().log(), 0).numpy()
        assert stats.chisquare(counts, expected).pvalue > 1e-5
        # Sites stay together.
        row = same.long().argmax(-1)
        assert torch.equal(pooled["reach"][:, person, 0], draws["reach"][row, person, 0])


def test_newcomers_are_from_the_population(pooling):
    number = 3000
    new = pooling.newcomers(population(by_rate(0.5, -1.0), by_rate(0.7, 0.4), number), 2, 0)
    assert list(new) == ["reach", *RATES]
    for person in range(2):
        counts = torch.bincount(new["reach"][:, person, 0], minlength=7).numpy()
        assert (
            stats.chisquare(counts, number * torch.arange(1.0, 8).double().numpy() / 28).pvalue
            > 1e-5
        )
        logit = torch.logit(new["in_sight"][:, person, 0]).numpy()
        assert stats.kstest(logit, stats.norm(0.5, 0.7).cdf).pvalue > 1e-5
    assert not torch.equal(new["in_sight"][:, 0], new["in_sight"][:, 1])


def test_similar_people_are_pooled(toy, pooling):
    """All see as far as bin 3 and hardly differ otherwise; of one there is a single round."""
    generator = torch.Generator().manual_seed(1)
    alike = {
        "reach": torch.full((8, 1), 3),
        "in_sight": torch.full((8, 1), 0.8),
        "otherwise": torch.full((8, 1), 0.05),
    }
    recordings = play_rounds(toy, alike, 6, "fog", generator)
    many = infer(toy, recordings, InferenceOptions("importance", 300), 0).draws
    one = infer(toy, recordings.select_rounds([0]), InferenceOptions("importance", 300), 0).draws
    found = pooling.fit(many, 100, 0)
    pooled = pooling.pooled(one, found, 0).draws

    def right(draws):
        return float((draws["reach"] == 3).float().mean())

    def off(draws):
        return float((draws["in_sight"] - 0.8).abs().mean())

    assert right(pooled) > right(one) + 0.1
    assert off(pooled) < 0.8 * off(one)
    new = pooling.newcomers(found, 1, 0)
    assert right(new) > 3 / 7
    assert float(new["otherwise"].mean()) < 0.12  # of Beta(1, 4) it is 0.2


class Scaled(ToyHuman):
    """A toy whose prior counts a tenth."""

    def prior(self):
        with poutine.scale(scale=0.1):
            return super().prior()


def test_scales_of_the_prior_count():
    self_model = load_self_model(shipped_weights("driving"))[0]
    plain, scaled = Pooling(ToyHuman(self_model)), Pooling(Scaled(self_model))
    draws = draw_prior(ToyHuman(self_model), 2, 5, 0)
    # The map to unconstrained space, which both have, is no part of the prior.
    nodes = sample_sites(plain.human, 2, 5, draws)
    density = sum(node["fn"].log_prob(node["value"]) for node in nodes.values())[..., 0]
    found = plain._log_prior(draws) - scaled._log_prior(draws)
    torch.testing.assert_close(found, 0.9 * density.T, rtol=1e-4, atol=1e-4)


class Near(ToyHuman):
    """A toy of whom the prior says more: nobody sees far. And of a kind, as one of three."""

    def prior(self):
        implants = super().prior()
        pyro.factor("near", -50.0 * (implants["reach"] > 2))
        kind = pyro.sample("kind", OneHotCategorical(torch.tensor([0.2, 0.3, 0.5])))
        return implants | {"kind": kind}


def test_newcomers_follow_what_the_prior_says_besides():
    human = Near(load_self_model(shipped_weights("driving"))[0])
    number = 2000
    some = population(by_rate(0.5, -1.0), by_rate(0.7, 0.4), number)
    new = Pooling(human).newcomers(some, 1, 0)
    assert new["kind"].shape == (number, 1, 1, 3)
    # Probabilities of 1, 2, 3 of 28; the others are as good as impossible.
    counts = torch.bincount(new["reach"].flatten(), minlength=7).numpy()
    assert counts[3:].sum() == 0
    expected = number * torch.arange(1.0, 4).double().numpy() / 6
    assert stats.chisquare(counts[:3], expected).pvalue > 1e-5


def test_a_population_of_people_with_sites_of_several_numbers():
    human = Near(load_self_model(shipped_weights("driving"))[0])
    pooling = Pooling(human)
    assert list(pooling.supports) == ["reach"]  # the other site keeps its prior
    pooling.read(draw_prior(human, 2, 5, 0))

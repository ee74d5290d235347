"""Partial pooling: weights by hand, and people who are alike."""

import pyro
import pytest
import torch
from scipy import stats
from torch.distributions import Beta, Normal

from mirror_ppl.inference.calibration import prior_people
from mirror_ppl.inference.guides import InferenceOptions, infer
from mirror_ppl.inference.pooling import Pooling, Population
from mirror_ppl.inference.simulation import play_rounds
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


def test_densities_by_hand(pooling, draws):
    known, place, log_prior = pooling.read(draws)
    assert place.shape == (3, 5, 2) and log_prior.shape == known["reach"].shape == (3, 5)
    chances = {"reach": torch.arange(1.0, 8) / 28}
    mean, spread = torch.tensor([0.5, -1.0]), torch.tensor([0.7, 0.4])
    found = pooling.log_density(chances, mean, spread, known, place)
    for person in range(3):
        for draw in range(5):
            reach = int(draws["reach"][draw, person])
            prior, density = -torch.tensor(7.0).log(), torch.tensor((reach + 1) / 28).log()
            for column, (site, (one, two)) in enumerate(RATES.items()):
                rate = draws[site][draw, person, 0]
                logit = torch.logit(rate)
                # d rate / d logit = rate (1 - rate)
                prior = prior + Beta(one, two).log_prob(rate) + (rate * (1 - rate)).log()
                density = density + Normal(mean[column], spread[column]).log_prob(logit)
            torch.testing.assert_close(log_prior[person, draw], prior, rtol=1e-4, atol=1e-4)
            torch.testing.assert_close(found[person, draw], density, rtol=1e-4, atol=1e-4)


def test_the_program_weighs_people_by_the_mean_of_ratios(pooling, draws):
    known, place, log_prior = pooling.read(draws)
    trace = pyro.poutine.trace(pooling.program).get_trace(known, place, log_prior)
    value = {name: trace.nodes[name]["value"] for name in ("reach_chances", "mean", "spread")}
    density = pooling.log_density(
        {"reach": value["reach_chances"]}, value["mean"], value["spread"], known, place
    )
    trace.compute_log_prob()
    expected = (density - log_prior).exp().mean(-1).log()
    torch.testing.assert_close(trace.nodes["rounds"]["log_prob"], expected)


def test_people_are_drawn_by_their_weights(pooling, draws):
    known, place, log_prior = pooling.read(draws)
    chances = {"reach": torch.arange(1.0, 8) / 28}
    mean, spread = torch.tensor([0.5, -1.0]), torch.tensor([0.7, 0.9])
    number = 4000
    population = Population(
        {"reach": chances["reach"].expand(number, 7)},
        mean.expand(number, 2),
        spread.expand(number, 2),
    )
    pooled = pooling.pooled(draws, population, 0)
    weights = torch.softmax(
        pooling.log_density(chances, mean, spread, known, place) - log_prior, -1
    )
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
    population = Population(
        {"reach": (torch.arange(1.0, 8) / 28).expand(number, 7)},
        torch.tensor([0.5, -1.0]).expand(number, 2),
        torch.tensor([0.7, 0.4]).expand(number, 2),
    )
    new = pooling.newcomers(population, 2, 0)
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


def test_people_who_are_alike_tell_of_each_other(toy, pooling):
    """All see as far as bin 3 and hardly differ otherwise; of one there is a single round."""
    generator = torch.Generator().manual_seed(1)
    alike = {
        "reach": torch.full((8, 1), 3),
        "in_sight": torch.full((8, 1), 0.8),
        "otherwise": torch.full((8, 1), 0.05),
    }
    recordings = play_rounds(toy, alike, 6, "fog", generator)
    many = infer(toy, recordings, InferenceOptions("exact", 300), 0).draws
    one = infer(toy, recordings.select_rounds([0]), InferenceOptions("exact", 300), 0).draws
    population = pooling.fit(many, 100, 0)
    pooled = pooling.pooled(one, population, 0)

    def right(draws):
        return float((draws["reach"] == 3).float().mean())

    def off(draws):
        return float((draws["in_sight"] - 0.8).abs().mean())

    assert right(pooled) > right(one) + 0.1
    assert off(pooled) < 0.8 * off(one)
    new = pooling.newcomers(population, 1, 0)
    assert right(new) > 3 / 7
    assert float(new["otherwise"].mean()) < 0.12  # of Beta(1, 4) it is 0.2

"""Gibbs sampling of a population, against sums over everything that two people may be like."""

import itertools

import pytest
import torch
from torch.distributions import Beta, LogNormal, MultivariateNormal, Normal
from torch.nn.functional import one_hot

from mirror_ppl.inference.population.sampler import (
    ContinuousSites,
    DiscreteSite,
    HyperPriors,
    PeoplesDraws,
    sample_population,
)

PRIORS = HyperPriors({"sees": torch.tensor([0.3, 0.7])}, 1.0, 0.5, 0.5)
SEES = torch.tensor([[0, 1], [1, 1], [0, 0]])
PLACE = torch.tensor([[0.7, 2.3], [2.0, 3.2], [1.5, 1.8]])
LOG_PRIOR = torch.tensor([[-1.0, -2.0], [0.3, -1.5], [0.0, 1.0]])
DRAWS = 2000


def people(sees=SEES, place=PLACE, log_prior=LOG_PRIOR):
    return PeoplesDraws({"sees": one_hot(sees, 2).float()}, place[..., None], log_prior)


@pytest.fixture(scope="module")
def grids():
    """Hyper-parameters of each site, and log of their prior density times the cell."""
    mean, log_spread = torch.linspace(-4, 4, 161), torch.linspace(-3.5, 2.0, 111)
    mean, log_spread = (part.double() for part in torch.meshgrid(mean, log_spread, indexing="ij"))
    spread = log_spread.exp()
    continuous = Normal(0.0, 1.0).log_prob(mean) + log_spread
    continuous = continuous + LogNormal(torch.tensor(0.5).log(), 0.5).log_prob(spread)
    chance = (torch.arange(400).double() + 0.5) / 400
    log_concentration = torch.linspace(-4.3, 5.7, 201).double()
    chance, log_concentration = torch.meshgrid(chance, log_concentration, indexing="ij")
    concentration = log_concentration.exp()
    discrete = LogNormal(torch.tensor(2.0).log(), 1.0).log_prob(concentration) + log_concentration
    discrete = discrete + Beta(0.3 * concentration, 0.7 * concentration).log_prob(chance)
    return (mean, spread, continuous), (chance, discrete)


def test_draws_have_the_exact_posterior(grids):
    (mean, spread, continuous), (chance, discrete) = grids
    totals, moments = [], []
    for chosen in itertools.product(range(2), repeat=3):  # which of their two draws each has
        own = [torch.tensor(chosen)[person] for person in range(3)]
        places = [PLACE[person, draw] for person, draw in enumerate(own)]
        sees = [SEES[person, draw] for person, draw in enumerate(own)]
        prior = sum(LOG_PRIOR[person, draw] for person, draw in enumerate(own))
        first = continuous + sum(Normal(mean, spread).log_prob(place) for place in places)
        second = discrete + sum((chance if see == 0 else 1 - chance).log() for see in sees)
        totals.append(first.logsumexp((0, 1)) + second.logsumexp((0, 1)) - prior)
        weight, share = (part.flatten().softmax(0).view_as(part) for part in (first, second))
        moments.append(
            torch.stack(
                [
                    *((weight * value).sum() for value in (mean, mean**2)),
                    *((weight * value).sum() for value in (spread.log(), spread.log() ** 2)),
                    *((share * value).sum() for value in (chance, chance**2)),
                ]
            )
        )
    expected = torch.stack(totals).softmax(0) @ torch.stack(moments)
    probabilities, means, spreads = sample_population(people(), PRIORS, DRAWS, 0)
    assert probabilities["sees"].shape == (DRAWS, 2) and means.shape == spreads.shape == (DRAWS, 1)
    torch.testing.assert_close(probabilities["sees"].sum(-1), torch.ones(DRAWS))
    for place, value in enumerate((means[:, 0], spreads[:, 0].log(), probabilities["sees"][:, 0])):
        # Of 2,000 draws that depend on each other at least 500 count; grids are finer than that.
        centre = expected[2 * place]
        width = (expected[2 * place + 1] - centre**2).sqrt()
        assert abs(value.double().mean() - centre) < 4.5 * width / 500**0.5
        assert 0.85 < value.double().std() / width < 1.15  # 4.5 standard errors of a normal


def test_spreads_are_weighed_with_the_mean_integrated_out():
    generator = torch.Generator().manual_seed(0)
    for people, centre in ((1, 0.0), (4, 2.0), (30, -0.5)):
        values = centre + torch.randn(people, 2, generator=generator).double() * 0.3
        sites = ContinuousSites(people, PRIORS, values)
        found = sites.log_densities(values)
        assert sites.grid[0] < -4.6 and sites.grid[-1] > 3.2  # eight of .5 around log .5
        for column in range(2):
            for cell in range(0, len(sites.grid), 40):
                spread = sites.grid[cell].exp()
                covariance = spread**2 * torch.eye(people).double() + 1
                joint = MultivariateNormal(torch.zeros(people).double(), covariance)
                prior = LogNormal(torch.tensor(0.5).double().log(), 0.5).log_prob(spread)
                one = joint.log_prob(values[:, column]) + prior + sites.grid[cell]
                if not cell:
                    offset = found[column, 0] - one
                torch.testing.assert_close(found[column, cell] - offset, one, rtol=1e-6, atol=1e-5)


def test_concentrations_are_weighted_with_probabilities_integrated_out():
    """By an urn: each person has a value as often as those before, and as the prior says."""
    prior = torch.tensor([0.2, 0.5, 0.3]).double()
    values = torch.tensor([2, 0, 2, 2, 1])
    site = DiscreteSite(len(values), prior, 1.0)
    found = site.log_densities(torch.bincount(values).double())
    for cell in range(0, len(site.grid), 40):
        concentration, count = site.grid[cell].exp(), torch.zeros(3).double()
        one = LogNormal(torch.tensor(3.0).double().log(), 1.0).log_prob(concentration)
        one = one + site.grid[cell]
        for number, value in enumerate(values):
            chance = concentration * prior[value] + count[value]
            one = one + (chance / (concentration + number)).log()
            count[value] += 1
        if not cell:
            offset = found[0] - one
        torch.testing.assert_close(found[cell] - offset, one, rtol=1e-6, atol=1e-4)


def test_sites_are_known_by_their_names():
    """Two discrete sites, of two and three values, in whatever order; and two continuous ones."""
    generator = torch.Generator().manual_seed(0)
    known = {
        "a": one_hot(torch.tensor([[0, 1], [1, 1], [0, 0]]), 2).float(),
        "b": one_hot(torch.tensor([[2, 2], [2, 1], [2, 2]]), 3).float(),
    }
    place = torch.stack([PLACE, 5 + torch.randn(3, 2, generator=generator)], -1)
    priors = HyperPriors({"a": torch.full((2,), 0.5), "b": torch.full((3,), 1 / 3)}, 1.0, 0.5, 0.5)
    turned = dict(reversed(known.items()))
    one, same = (
        sample_population(PeoplesDraws(own, place, LOG_PRIOR), priors, 300, 0)
        for own in (known, turned)
    )
    assert all(torch.equal(one[0][name], same[0][name]) for name in known)
    assert one[0]["b"].shape == (300, 3) and one[0]["b"].mean(0)[2] > 0.6
    assert one[0]["a"].mean(0)[0] == pytest.approx(0.5, abs=0.2)
    assert one[1][:, 1].mean() > one[1][:, 0].mean() + 0.5


def test_the_seed_decides():
    one, same, other = (sample_population(people(), PRIORS, 3, seed)[1] for seed in (0, 0, 1))
    assert torch.equal(one, same) and not torch.equal(one, other)


def test_impossible_values_have_small_probabilities():
    """Nobody has a value that the prior hardly allows: its chance has a logarithm all the same."""
    priors = HyperPriors({"sees": torch.tensor([1e-6, 1 - 1e-6])}, 1.0, 0.5, 0.5)
    probabilities, *_ = sample_population(people(torch.ones_like(SEES)), priors, 50, 0)
    assert (probabilities["sees"] > 0).all() and (probabilities["sees"][:, 0] < 1e-3).all()


def test_sweeps_are_reported():
    told = []
    sample_population(people(), PRIORS, 4, 0, lambda done, total: told.append((done, total)))
    assert told == [(done, 320) for done in range(321)]

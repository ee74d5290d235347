"""Importance sampling of a hierarchical toy whose posterior is known: proposals, weights."""

import math
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch.distributions import MultivariateNormal

from mirror_ppl.domains import get_domain
from mirror_ppl.inference import adaptive_importance as importance
from mirror_ppl.inference import sampler as sampler_module
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.hierarchical_proposal import RelativeProposal, dependent_sites
from mirror_ppl.inference.sampler import Sampler
from mirror_ppl.inference.weighted import Weighted
from mirror_ppl.likelihood.combination_sets import EquivalentCombinations
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.models import HumanModel
from mirror_ppl.models.prior import draw_prior, scalar_sites, unconstrained
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.toy import RATES, ToyHuman
from mirror_ppl.people import simulate

HABITS, CHANCES = (0.2, 0.6), (0.98, 0.02)
"""Rates of the second action with nothing in sight, and how probable each is."""
EVEN = (1.0, 1.5)
NEAR = 0.02
"""By how much it is less probable that they see a bin further."""


class Habitual(ToyHuman):
    """A toy whose rate in sight is spread as ``evenness`` says, and whose other rate is a habit."""

    def prior(self):
        like = next(self.self_model.parameters())
        bins = NEAR ** torch.arange(len(self.domain.reach_bins)).to(like)
        evenness = pyro.sample("evenness", dist.LogNormal(*like.new_tensor(EVEN)))
        return {
            "reach": pyro.sample("reach", dist.Categorical(bins / bins.sum())),
            "evenness": evenness,
            "in_sight": pyro.sample("in_sight", dist.Beta(evenness, evenness)),
            "habit": pyro.sample("habit", dist.Categorical(like.new_tensor(CHANCES))),
        }

    def act(self, implants, belief, values):
        rate = torch.tensor(HABITS)[implants["habit"].long()]
        return super().act({**implants, "otherwise": rate}, belief, values)


@pytest.fixture(scope="module")
def toy():
    torch.manual_seed(0)
    return Habitual(SelfModel(get_domain("driving")))


@pytest.fixture(scope="module")
def table(toy):
    """A person who changes lanes at half of their steps."""
    recorded = simulate("driving", "fog", people=1, rounds=3, seed=0)
    shape = recorded.actions.shape
    second = (torch.arange(shape.numel()) % 2 > 0).long().view(shape)
    return build_view_table(toy, replace(recorded, actions=second))


def exact(table):
    """Posterior probability of the second habit, and mean of the other rate, on a grid of evenness.

    By conjugacy: actions are throws of two coins, given the reach.
    """
    seen = table.belief[0, :, 0] > 0  # [N]
    evenness = torch.linspace(EVEN[0] - 6 * EVEN[1], EVEN[0] + 6 * EVEN[1], 4001).double().exp()
    prior = dist.LogNormal(*torch.tensor(EVEN).double()).log_prob(evenness) + evenness.log()
    evidence, rates = [], []
    for combination in range(table.index.shape[-1]):
        moments = table.moments[0, table.index[0, :, combination]]
        moments = moments[moments >= 0]
        near, second = seen[moments], table.acted[0, moments] == 1
        one, two = (second & near).sum(), (~second & near).sum()
        three, four = (second & ~near).sum(), (~second & ~near).sum()
        own = prior + beta(evenness + one, evenness + two) - beta(evenness, evenness)
        own = own + combination * torch.tensor(NEAR).log()
        for rate, chance in zip(torch.tensor(HABITS), torch.tensor(CHANCES), strict=True):
            evidence.append(own + chance.log() + three * rate.log() + four * torch.log1p(-rate))
            rates.append((evenness + one) / (2 * evenness + one + two))
    weights = torch.softmax(torch.stack(evidence).flatten(), 0).view(len(evidence), -1)
    return {
        "habit": float(weights[1::2].sum()),
        "in_sight": float((weights * torch.stack(rates)).sum()),
    }


def beta(one, two):
    one, two = torch.as_tensor(one).double(), torch.as_tensor(two).double()
    return torch.lgamma(one) + torch.lgamma(two) - torch.lgamma(one + two)


def test_the_posterior_is_that_of_conjugacy(toy, table):
    truth = exact(table)
    assert 0.2 < truth["habit"] < 0.95  # of a prior of .02, so that proposals have to find it
    for seed in range(3):
        torch.manual_seed(seed)
        found = sample_importance(toy, table, ImportanceOptions())
        assert found.effective > 200 and found.pareto_k < 0.7
        weights = found.log_weights.exp().float()
        for name, expected in truth.items():
            value = found.policy[name].flatten().float()
            mean = float((weights * value).sum())
            error = float((weights * (value - mean).square()).sum() / found.effective) ** 0.5
            assert abs(mean - expected) < 4.5 * error + 1e-3, (name, mean, expected)


def test_draws_before_something_was_learned_count_as_they_were_drawn(toy, table):
    """Half of the draws have discrete sites from the prior, half as learned."""
    truth = exact(table)
    torch.manual_seed(0)
    sampler = Sampler(toy, table)
    sampler.draw(2000)
    place, weights = sampler.place, sampler.weighted().log_weights
    gaussian = importance._heavy_tailed(place, weights, 1.5)
    sampler.propose(gaussian, 2000)
    sampler.learn_discrete(sampler.weighted())
    sampler.propose(gaussian, 500)
    found = sampler.weighted()
    share = float((found.log_weights.exp() * found.policy["habit"].flatten()).sum())
    expected = truth["habit"]
    error = (expected * (1 - expected) / found.effective) ** 0.5
    assert abs(share - expected) < 4.5 * error


def weighted(log_weights):
    weights = torch.log_softmax(torch.as_tensor(log_weights).double(), 0)
    return Weighted({}, None, weights[:, None], weights, 0.0, 0.0)


def test_weights_are_toned_down_until_enough_draws_count():
    torch.manual_seed(0)
    sharp = weighted(20 * torch.randn(1000))
    assert sharp.effective < 3
    found = sharp.tempered(64.0)
    assert found.effective == pytest.approx(64, rel=0.01)
    # A power of them: log weights are in line.
    slope = (found.log_weights[1:] - found.log_weights[0]) / (
        sharp.log_weights[1:] - sharp.log_weights[0]
    )
    torch.testing.assert_close(slope, slope[0].expand_as(slope))
    assert 0 < slope[0] < 1
    # Of few draws a quarter, and what is flat enough stays as it is.
    assert weighted([0.0, -50.0] * 10).tempered(64.0).effective >= 5
    flat = weighted(torch.randn(1000))
    assert flat.tempered(64.0) is flat
    # Draws that cannot be stay so.
    impossible = torch.full((100,), -torch.inf)
    impossible[:2] = torch.tensor([0.0, -1000.0])
    found = weighted(impossible).tempered(64.0)
    assert found.effective == pytest.approx(2, rel=0.01)
    assert (found.log_weights[2:] == -torch.inf).all()


def test_probable_combinations_have_all_but_a_negligible_probability():
    """Sets of 2, 1 and 1 combinations under two draws, of which one set has 0.00004 on average."""
    sets = EquivalentCombinations(
        first=torch.tensor([7, 1, 4]),
        log_prior=torch.zeros(3),
        fixed=True,
        members=torch.tensor([7, 2, 1, 4]),
        share=torch.tensor([0.5, 1.0, 2.0, 3.0]),
        end=torch.tensor([2, 3, 4]),
    )
    given = torch.tensor([[0.5, 0.49992, 0.00008], [0.2, 0.8, 0.0]])
    found = Weighted({}, sets, given.log(), torch.tensor([0.5, 0.5]).log(), 0.0, 0.0)
    assert found.probable.tolist() == [1, 2, 7]
    rarer = replace(found, log_weights=torch.tensor([0.0, -torch.inf]))
    assert rarer.probable.tolist() == [1, 2, 7]
    likelier = torch.tensor([[0.5, 0.4998, 0.0002], [0.2, 0.8, 0.0]]).log()
    assert replace(rarer, log_joint=likelier).probable.tolist() == [1, 2, 4, 7]


def test_what_is_proposed_has_heavy_tails_and_these_moments():
    torch.manual_seed(0)
    place = torch.randn(400, 2) @ torch.tensor([[1.0, 0.5], [0.0, 2.0]]) + 3
    even = torch.full((400,), -math.log(400.0)).double()
    proposal = importance._heavy_tailed(place, even, 1.2)
    torch.testing.assert_close(proposal.loc, place.mean(0))
    covariance = 1.2 * place.T.cov(correction=0) + torch.diag(1e-3 * place.var(0) + 1e-8)
    torch.testing.assert_close(proposal.scale_tril @ proposal.scale_tril.T, covariance)
    far = place.mean(0) + torch.tensor([[100.0, 0.0]])
    gaussian = MultivariateNormal(place.mean(0), covariance)
    assert float(proposal.log_prob(far) - gaussian.log_prob(far)) > 100


def test_sites_that_depend_on_others_are_found(toy):
    assert dependent_sites(toy, scalar_sites(toy)) == ("in_sight",)
    human = HumanModel(SelfModel(get_domain("driving")))
    assert dependent_sites(human, scalar_sites(human)) == ()


def test_a_relative_gaussian_is_the_density_of_what_it_draws(toy):
    """A rate's logit is Gaussian after division by a scale that depends on ``evenness``."""
    sites = scalar_sites(toy)
    drawn = draw_prior(toy, 1, 400, 0)
    place = unconstrained(sites, drawn)
    torch.manual_seed(0)
    proposal = RelativeProposal(
        toy,
        sites,
        ("in_sight",),
        place,
        lambda some: MultivariateNormal(some.mean(0), some.T.cov()),
    )
    found = proposal.sample(torch.Size([500]))
    assert found.shape == (500, 2)
    names = list(sites)
    log_even, rate = found[:, names.index("evenness")], found[:, names.index("in_sight")]
    # Of Beta(e, e): mean 1/2, variance 1 / (4 (2 e + 1)), stretched by 4 in the logit.
    scale = 2 / (2 * log_even.exp() + 1).sqrt()
    columns = found.clone()
    columns[:, names.index("in_sight")] = rate / scale
    expected = proposal.density.log_prob(columns) - scale.log()
    torch.testing.assert_close(proposal.log_prob(found), expected, rtol=1e-4, atol=1e-4)


class Spread(ToyHuman):
    """A toy of whom something else than a number decides how far rates in sight are spread."""

    def prior(self):
        like = next(self.self_model.parameters())
        bins = NEAR ** torch.arange(len(self.domain.reach_bins)).to(like)
        sites = self.hyper(like)
        (evenness,) = (evenness_of(site) for site in sites.values())
        return {
            "reach": pyro.sample("reach", dist.Categorical(bins / bins.sum())),
            "in_sight": pyro.sample("in_sight", dist.Beta(evenness, evenness)),
            "otherwise": pyro.sample("otherwise", dist.Beta(*like.new_tensor(RATES["otherwise"]))),
            **sites,
        }


def evenness_of(site):
    """Beta(1, 1) or Beta(60, 60), by a kind or the sign of a vector."""
    high = (site[..., 0] > 0) if site.dtype.is_floating_point else site == 1
    return torch.where(high, 60.0, 1.0)


class ByKind(Spread):
    def hyper(self, like):
        return {"kind": pyro.sample("kind", dist.Categorical(like.new_ones(2) / 2))}


class ByVector(Spread):
    def hyper(self, like):
        return {"sign": pyro.sample("sign", dist.Normal(like.new_zeros(1), 1.0).to_event(1))}


@pytest.mark.parametrize(("kind", "name"), [(ByKind, "kind"), (ByVector, "sign")])
def test_priors_that_depend_on_other_sites_count_as_they_are(toy, table, kind, name):
    """Half of the prior is Beta(1, 1) and half Beta(60, 60): the posterior by conjugacy."""
    human = kind(toy.self_model)
    assert dependent_sites(human, scalar_sites(human)) == ()
    seen = table.belief[0, :, 0] > 0
    evidence = torch.zeros(2, table.index.shape[-1]).double()
    for combination in range(table.index.shape[-1]):
        moments = table.moments[0, table.index[0, :, combination]]
        moments = moments[moments >= 0]
        near, second = seen[moments], table.acted[0, moments] == 1
        one, two = (second & near).sum(), (~second & near).sum()
        three, four = (second & ~near).sum(), (~second & ~near).sum()
        a, b = RATES["otherwise"]
        for place, e in enumerate((1.0, 60.0)):
            evidence[place, combination] = (
                beta(e + one, e + two) - beta(e, e) + beta(a + three, b + four) - beta(a, b)
            ) + combination * torch.tensor(NEAR).log()
    expected = float(torch.softmax(evidence.logsumexp(1), 0)[1])
    assert 0.02 < expected < 0.98
    for seed in range(3):
        torch.manual_seed(seed)
        found = sample_importance(human, table, ImportanceOptions(proposals=2048))
        high = evenness_of(found.policy[name]).flatten() > 1
        share = float((found.log_weights.exp() * high).sum())
        error = (expected * (1 - expected) / found.effective) ** 0.5
        assert abs(share - expected) < 4.5 * error


class Odd(ToyHuman):
    """A toy with a site of a distribution that has no moments, or several numbers a value."""

    odd = dist.HalfCauchy(torch.tensor(1.0))

    def prior(self):
        return {**super().prior(), "odd": pyro.sample("odd", self.odd)}


@pytest.mark.parametrize(
    ("odd", "middle", "expected"),
    [
        (dist.HalfCauchy(torch.tensor(1.0)), 1.0, 0.5),
        (dist.StudentT(torch.tensor(1.0)), 0.0, 0.5),
        (
            dist.TransformedDistribution(
                dist.Normal(torch.tensor(0.0), 1.0), [torch.distributions.SigmoidTransform()]
            ),
            0.5,
            0.5,
        ),
        (dist.OneHotCategorical(torch.ones(3) / 3), None, 1 / 3),
    ],
)
def test_any_distribution_can_be_a_prior(toy, table, odd, middle, expected):
    """What nothing recorded tells of keeps its prior: so much of it is below a number."""
    human = Odd(toy.self_model)
    human.odd = odd
    torch.manual_seed(0)
    found = sample_importance(human, table, ImportanceOptions())
    below = (found.policy["odd"][..., 0] == 1) if odd.event_dim else found.policy["odd"] < middle
    share = float((found.log_weights.exp() * below.flatten()).sum())
    assert abs(share - expected) < 4.5 * (expected * (1 - expected) / found.effective) ** 0.5


class OnlyAHabit(ToyHuman):
    """Nobody's rates are open but for the habit."""

    def prior(self):
        like = next(self.self_model.parameters())
        bins = NEAR ** torch.arange(len(self.domain.reach_bins)).to(like)
        return {
            "reach": pyro.sample("reach", dist.Categorical(bins / bins.sum())),
            "habit": pyro.sample("habit", dist.Categorical(like.new_tensor(CHANCES))),
        }

    def act(self, implants, belief, values):
        rate = torch.tensor(HABITS)[implants["habit"].long()]
        rates = {"in_sight": torch.full_like(rate, 0.5), "otherwise": rate}
        return super().act({**implants, **rates}, belief, values)


def test_discrete_sites_alone_are_proposed_too(toy, table):
    torch.manual_seed(0)
    found = sample_importance(OnlyAHabit(toy.self_model), table, ImportanceOptions())
    assert found.effective > 400  # of the prior's draws 2 in 100 would count


def test_discrete_sites_count_as_they_were_drawn(toy, table, monkeypatch):
    """From the prior until it was learned how probable they are."""
    monkeypatch.setattr(sampler_module, "pareto_smoothed", lambda raw: (raw, 0.0))
    torch.manual_seed(0)
    sampler = Sampler(toy, table)
    sampler.draw(100)
    gaussian = importance._heavy_tailed(sampler.place, torch.full((100,), -math.log(100.0)), 1.5)
    sampler.propose(gaussian, 60)
    sampler.learn_discrete(sampler.weighted())
    sampler.propose(gaussian, 40)
    found = sampler.weighted()
    scalars, _ = sampler._log_prior.double()
    habit = found.policy["habit"].flatten()
    prior = torch.tensor(CHANCES).double()[habit].log()
    learned = sampler._log_probabilities["habit"][habit]
    own = gaussian.log_prob(sampler.place).double()
    stages = [scalars + prior, own + prior, own + learned]
    shares = torch.tensor([0.5, 0.3, 0.2]).double().log()
    mixture = (torch.stack(stages, -1) + shares).logsumexp(-1)
    expected = found.log_joint.double().logsumexp(-1) + scalars + prior - mixture
    torch.testing.assert_close(found.log_weights.double(), expected, rtol=1e-4, atol=1e-3)

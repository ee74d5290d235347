"""Where to look for a residual: the Gaussian that is proposed, what it is learned from, weights."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch

from mirror_ppl.inference import adaptive_importance as importance
from mirror_ppl.inference import residual_proposal
from mirror_ppl.inference import sampler as sampler_module
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.residual_proposal import ResidualProposal, _laplace
from mirror_ppl.inference.sampler import Sampler, complete
from mirror_ppl.likelihood.enumeration import expected_counts
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models import HumanModel
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def human():
    return HumanModel(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def played(human):
    """A person who changes lanes whenever they can, by a residual twice as large as usual."""
    generator = torch.Generator().manual_seed(0)
    out = torch.zeros(1, 1, 9, 2)
    out[..., -1, :] = torch.tensor([-0.2, 0.2])
    implants = {"residual_out": out, "lapse": torch.full((1, 1), 0.02)}
    return play_rounds(human, implants, 6, "fog", generator)


class OnResidual(HumanModel):
    """Sites whose priors depend on the residual, which would be replaced after they are drawn."""

    def prior(self):
        found = super().prior()
        level = 10 * found["residual_out"][..., -1, 0]
        near = pyro.sample("near", dist.Normal(level, 0.3))
        two = pyro.sample("two", dist.Normal(level[..., None], torch.full((2,), 0.3)).to_event(1))
        alike = pyro.sample("alike", dist.Bernoulli(logits=5 * level))
        return found | {"near": near, "two": two, "alike": alike}

    def act(self, implants, belief, values):
        nothing = implants["near"] + implants["two"].sum(-1) + implants["alike"]
        return super().act(implants, belief, values) + 0 * nothing[..., None]


def test_residuals_on_which_other_sites_depend_are_not_replaced(human, played):
    number = 1000
    found = infer(OnResidual(human.self_model), played, InferenceOptions("importance", number), 0)
    level = 10 * found.draws["residual_out"][..., -1, 0]
    # Of 400 effective draws, a standard deviation of .3 has a standard error of .011.
    for own in (found.draws["near"] - level, found.draws["two"][..., 0] - level):
        assert abs(float(own.std()) - 0.3) < 4 * 0.011
    rate = torch.sigmoid(5 * level)
    agrees = torch.where(found.draws["alike"] > 0, rate, 1 - rate).mean()
    expected = (rate.square() + (1 - rate).square()).mean()
    assert abs(float(agrees - expected)) < 4 * 0.5 / 400**0.5


@pytest.fixture(scope="module")
def table(human, played):
    builder = ViewTableBuilder(human, Screening())
    builder.add(rounds_of(played, 0))
    return builder.table()


def test_the_gaussian_is_at_the_mode_and_as_curved_as_the_likelihood():
    torch.manual_seed(0)
    without, features = torch.randn(3, 40, 4).double(), torch.randn(3, 40, 5).double()
    counts, scale = torch.rand(40, 4).double() * 2, torch.tensor(0.4).double()

    def log_joint(weights, place):
        logits = without[place] + features[place] @ weights.view(5, 4)
        return (counts * logits.log_softmax(-1)).sum() - (weights / scale).pow(2).sum() / 2

    found = _laplace(without, features, counts, scale)
    for place in range(3):
        mode = found.mean[place].clone().requires_grad_()
        (slope,) = torch.autograd.grad(log_joint(mode, place), mode)
        assert slope.abs().max() < 0.02
        curved = torch.autograd.functional.hessian(lambda w: log_joint(w, place), mode)  # noqa: B023
        error = (found.precision_matrix[place] + curved).abs().max() / curved.abs().max()
        assert error < 0.1


def test_rounding_leaves_the_gaussian_a_gaussian():
    """Sums of many large parts that nearly cancel, in one order on one side of the diagonal."""
    generator = torch.Generator().manual_seed(0)
    without = torch.randn(200, 300, 2, generator=generator)
    features = 10 * torch.randn(200, 300, 9, generator=generator)
    found = _laplace(without, features, torch.ones(300, 2), torch.tensor(0.1))
    assert torch.equal(found.precision_matrix, found.precision_matrix.mT)
    assert found.sample().isfinite().all()


def test_expected_counts_are_of_what_was_done(human, played, table):
    """They add up to the actions; where one combination is left they are those that were taken."""
    sampler = Sampler(human, table)
    sampler.draw(20)
    found = sampler.weighted()
    even = torch.zeros(20)
    counts = expected_counts(
        human, table, found.policy, even, sampler.combinations.first, sampler.combinations.log_prior
    )
    steps = int(played.mask.sum())
    assert float(counts.sum()) == pytest.approx(steps, rel=1e-4)
    by_action = counts.sum(0)
    assert float(by_action[1]) == pytest.approx(int((played.actions == 1).sum()), rel=1e-4)
    one = sampler.combinations.first[:1]
    counts = expected_counts(human, table, found.policy, even, one, torch.zeros(1))
    torch.testing.assert_close(counts, counts.round(), rtol=0, atol=1e-4)
    # In moments of the views that this combination has, and in no others.
    views = table.index[0, :, one[0]]
    moments = table.moments[0, views]
    expected = torch.zeros(len(counts))
    real = table.steps[0]
    expected.index_add_(0, moments[real], torch.ones(steps))
    torch.testing.assert_close(counts.sum(-1), expected, rtol=0, atol=1e-4)


def test_what_is_left_out_counts_as_what_is_nearest(human, table, monkeypatch):
    monkeypatch.setattr(residual_proposal, "MOMENTS", 5)
    torch.manual_seed(0)
    counts = torch.rand(*table.acted[0].shape, 2)
    counts[7] = 10
    found = ResidualProposal.of(human, table, counts)
    assert found.counts.shape == (5, 2)
    torch.testing.assert_close(found.counts.sum(0), counts.sum(0))
    assert found.counts.sum(-1).max() >= 20
    monkeypatch.setattr(human, "likelihood_power", 0.25, raising=False)
    less = ResidualProposal.of(human, table, counts)
    torch.testing.assert_close(less.counts, found.counts / 4)


def test_weights_are_right_whatever_is_proposed(human, table, monkeypatch):
    """Means with the residual proposed and without agree within what chance explains."""
    torch.manual_seed(0)
    plain = Sampler(human, table)
    plain.draw(3000)
    proposed = Sampler(human, table)
    proposed.draw(300)
    proposed.learn_residual(proposed.weighted())
    gaussian = importance._heavy_tailed(proposed.place, proposed.weighted().log_weights, 1.5)
    for _ in range(3):
        proposed.propose(gaussian, 400)
    assert proposed._log_residual.shape == (2, 1500)
    one, other = plain.weighted(), proposed.weighted()
    assert other.effective > 200 and other.pareto_k < 0.7

    def moments(found, value):
        weights = found.log_weights.exp()
        mean = float((weights * value).sum())
        variance = float((weights * (value - mean).square()).sum())
        return mean, variance / found.effective

    for name, value in {
        "consistency": lambda policy: policy["consistency"].flatten(),
        "bias": lambda policy: policy["residual_out"][..., -1, 1].flatten(),
        "size": lambda policy: policy["residual_out"].square().sum((-1, -2)).flatten(),
    }.items():
        (first, error), (second, more) = (moments(w, value(w.policy)) for w in (one, other))
        assert abs(first - second) < 4.5 * (error + more) ** 0.5, name


def test_proposed_residuals_are_of_the_gaussian_and_some_of_the_prior(human, table):
    torch.manual_seed(0)
    sampler = Sampler(human, table)
    sampler.draw(100)
    sampler.learn_residual(sampler.weighted())
    gaussian = importance._heavy_tailed(sampler.place, sampler.weighted().log_weights, 1.5)
    torch.manual_seed(1)
    sampler.propose(gaussian, 200)
    prior, proposed = sampler._log_residual[:, 100:]
    # Each kind is likelier where it came from.
    assert (proposed - prior)[20:].mean() > (proposed - prior)[:20].mean()
    last = sampler._policies[-1]["residual_out"]
    density = complete(human, table, {"residual_out": last}, 200)[1]["residual_out"]
    torch.testing.assert_close(prior, density)


def test_the_residual_is_proposed_only_where_scalars_are_not_enough(human, table, monkeypatch):
    learned = []
    learn = Sampler.learn_residual
    monkeypatch.setattr(
        Sampler,
        "learn_residual",
        lambda self, found: (learned.append(len(self.place)), learn(self, found)),
    )
    monkeypatch.setattr(importance, "FEW", 0.0)
    torch.manual_seed(0)
    sample_importance(human, table, ImportanceOptions(proposals=256, enough=100))
    assert not learned
    options = ImportanceOptions(proposals=256, enough=1e6, stages=4)
    sample_importance(human, table, options)
    assert learned == [256 * 3]
    # At once where few draws have all the weight.
    learned.clear()
    monkeypatch.setattr(importance, "FEW", 1e6)
    sample_importance(human, table, options)
    assert learned == [256]


def test_residuals_count_as_they_were_drawn(human, table, monkeypatch):
    """From the prior until it was learned where to look, and a tenth of them afterwards."""
    monkeypatch.setattr(sampler_module, "pareto_smoothed", lambda raw: (raw, 0.0))
    torch.manual_seed(0)
    sampler = Sampler(human, table)
    sampler.draw(100)
    gaussian = importance._heavy_tailed(sampler.place, torch.full((100,), -math.log(100.0)), 1.5)
    sampler.propose(gaussian, 60)
    sampler.learn_residual(sampler.weighted())
    sampler.propose(gaussian, 40)
    prior, proposed = sampler._log_residual.double().exp()
    scalars = sampler._log_prior[0].double().exp()
    own = gaussian.log_prob(sampler.place).double().exp()
    mixture = 0.5 * scalars * prior + 0.3 * own * prior + 0.2 * own * (0.1 * prior + 0.9 * proposed)
    found = sampler.weighted()
    expected = found.log_joint.double().logsumexp(-1) + (scalars * prior / mixture).log()
    torch.testing.assert_close(found.log_weights.double(), expected, rtol=1e-4, atol=1e-3)

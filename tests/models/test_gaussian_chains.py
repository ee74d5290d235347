"""Gaussian chains: densities, draws and their gradients."""

import math

import pytest
import torch
from example_implants import ACTIONS, LATENT, STEPS
from example_networks import encoder
from torch.distributions import Normal

from mirror_ppl.models.distributions import GaussianChain
from mirror_ppl.models.networks import Gaussian, Transition

HIDDEN = 64


def initial(*batch, dtype=torch.float64):
    return Gaussian(
        torch.randn(*batch, LATENT, dtype=dtype), 0.1 + torch.rand(*batch, LATENT, dtype=dtype)
    )


def chains():
    """A chain whose inputs are actions, and one whose inputs are vectors; batches of 3 and 2 x 3"""
    actions = torch.randint(ACTIONS, (3, STEPS))
    yield GaussianChain(initial(3), Transition(LATENT, ACTIONS).double(), actions, 0)
    evidence = torch.randn(2, 3, STEPS, HIDDEN, dtype=torch.float64)
    yield GaussianChain(initial(2, 3), encoder(), evidence, 1)


def test_chain_log_prob_is_the_sum_over_steps_of_normals():
    for chain in chains():
        value = torch.randn(*chain.batch_shape, STEPS + 1, LATENT, dtype=torch.float64)
        expected = Normal(*chain.initial).log_prob(value[..., 0, :]).sum(-1)
        for step in range(1, STEPS + 1):
            inputs = chain.inputs.select(chain.time, step - 1)
            density = Normal(*chain.step(value[..., step - 1, :], inputs))
            expected = expected + density.log_prob(value[..., step, :]).sum(-1)
        assert chain.log_prob(value).shape == chain.batch_shape
        torch.testing.assert_close(chain.log_prob(value), expected)


def test_chain_draws_are_reparameterized():
    # The released MIRROR code drew latent states without this: its implants got no gradient.
    for chain in chains():
        for part in chain.initial:
            part.requires_grad_()
        assert chain.has_rsample
        chain.rsample()[..., -1, :].sum().backward()
        for part in (*chain.initial, *chain.step.head.parameters(), *chain.step.body.parameters()):
            assert part.grad is not None
            assert part.grad.abs().max() > 0


def linear_chain(batch, steps, decay, drift, noise, first):
    """z_t = decay z_{t-1} + drift u_t + noise e_t, and its parameters."""
    mean, scale = (torch.full((batch, 1), value, dtype=torch.float64) for value in first)
    inputs = torch.arange(1.0, steps + 1, dtype=torch.float64).expand(batch, steps)[..., None]

    def step(previous, inputs):
        mean = decay * previous + drift * inputs
        return Gaussian(mean, torch.full_like(mean, noise))

    return GaussianChain(Gaussian(mean, scale), step, inputs, 1)


def test_chain_gradient_of_a_linear_chain_is_exact():
    chain = linear_chain(1, 6, decay=0.8, drift=0.3, noise=0.5, first=(1.0, 2.0))
    chain.initial.mean.requires_grad_()
    chain.rsample()[0, -1, 0].backward()
    assert chain.initial.mean.grad.item() == pytest.approx(0.8**6, rel=1e-12)


def test_chain_marginals_of_a_linear_chain():
    number, steps, decay, drift, noise = 40_000, 4, 0.8, 0.3, 0.5
    chain = linear_chain(number, steps, decay, drift, noise, first=(1.0, 2.0))
    z = chain.sample()[..., 0]
    means, variances = [1.0], [4.0]
    for step in range(1, steps + 1):
        means.append(decay * means[-1] + drift * step)
        variances.append(decay**2 * variances[-1] + noise**2)
    # 15 comparisons at 4.5 standard errors: wrong once in 10,000.
    for step in range(steps + 1):
        error = math.sqrt(variances[step] / number)
        assert z[:, step].mean().item() == pytest.approx(means[step], abs=4.5 * error)
        error = variances[step] * math.sqrt(2 / number)
        assert z[:, step].var().item() == pytest.approx(variances[step], abs=4.5 * error)
    for step in range(steps):
        expected = decay * variances[step]
        error = math.sqrt((variances[step] * variances[step + 1] + expected**2) / number)
        covariance = torch.cov(z[:, step : step + 2].T)[0, 1].item()
        assert covariance == pytest.approx(expected, abs=4.5 * error)
    # Minus the log density of a draw is the entropy, but for a half chi-square with steps + 1.
    scales = torch.tensor([2.0] + [noise] * steps, dtype=torch.float64)
    entropy = Normal(0.0, scales).entropy().sum().item()
    error = math.sqrt((steps + 1) / 2 / number)
    assert -chain.log_prob(z[..., None]).mean().item() == pytest.approx(entropy, abs=4.5 * error)


def test_chain_draws_several_at_once_from_either_network():
    for chain in chains():
        draws = chain.rsample(torch.Size([5]))
        assert draws.shape == (5, *chain.batch_shape, STEPS + 1, LATENT)
        assert chain.log_prob(draws).shape == (5, *chain.batch_shape)
        torch.testing.assert_close(chain.log_prob(draws)[3], chain.log_prob(draws[3]))


def test_chain_has_one_trajectory_for_each_of_its_inputs():
    chain = next(chains())
    assert chain.expand(torch.Size([3])) is chain
    with pytest.raises(ValueError, match="one trajectory for each"):
        chain.expand(torch.Size([2, 3]))

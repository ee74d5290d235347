"""Draws of a mixture of Gaussians have the gradients that their distribution has."""

import pyro.distributions as dist
import torch
from scipy import stats

from mirror_ppl.inference.mixture import GaussianMixture

DRAWS = 100_000


def parameters(components):
    torch.manual_seed(0)
    size = 2
    raw = torch.randn(components, size, size, dtype=torch.double)
    lower = torch.tril(raw, -1) + torch.diag_embed(raw.diagonal(dim1=-2, dim2=-1).exp())
    logits, mean = torch.randn(components).double(), torch.randn(components, size).double()
    return [value.requires_grad_() for value in (logits, mean, lower)]


def mixture(logits, mean, lower):
    return GaussianMixture(
        dist.Categorical(logits=logits), dist.MultivariateNormal(mean, scale_tril=lower)
    )


def test_one_component_moves_as_a_gaussian_does():
    logits, mean, lower = parameters(1)
    drawn = mixture(logits, mean, lower).rsample((5,))
    noise = torch.linalg.solve_triangular(lower[0], (drawn - mean)[..., None], upper=False)
    expected = mean + (lower[0] @ noise.detach()).squeeze(-1)
    weights = torch.randn(5, 2).double()
    found = torch.autograd.grad((weights * drawn).sum(), [mean, lower], retain_graph=True)
    for own, other in zip(
        found, torch.autograd.grad((weights * expected).sum(), [mean, lower]), strict=True
    ):
        torch.testing.assert_close(torch.tril(own), torch.tril(other))


def test_gradients_of_a_moment_are_those_in_closed_form():
    values = parameters(3)
    logits, mean, lower = values
    factor = torch.tril(lower)
    covariance = factor @ factor.mT
    moments = covariance[:, 0, 1] + mean[:, 0] * mean[:, 1]
    moments = moments + covariance[:, 1, 1] + mean[:, 1].square()
    exact = torch.autograd.grad((logits.softmax(0) * moments).sum(), values)
    batches = []
    for _ in range(50):
        first, second = mixture(*values).rsample((DRAWS // 50,)).unbind(-1)
        found = torch.autograd.grad((first * second + second.square()).mean(), values)
        batches.append(torch.cat([one.flatten() for one in found]))
    found = torch.stack(batches)
    error = found.std(0) / 50**0.5
    off = (found.mean(0) - torch.cat([one.flatten() for one in exact])).abs()
    number = stats.t.ppf(1 - 5e-7, 49)
    assert (off <= number * error + 1e-9).all()
    assert error.max() < 0.05


def test_without_gradients_it_draws_alike():
    values = parameters(3)
    torch.manual_seed(1)
    with torch.no_grad():
        plain = mixture(*values).rsample((7,))
    torch.manual_seed(1)
    torch.testing.assert_close(mixture(*values).rsample((7,)).detach(), plain)

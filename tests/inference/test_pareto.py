"""Pareto-smoothed weights beside those of ArviZ, which are too slow to import in every process."""

import math

import arviz as az
import pytest
import torch

from mirror_ppl.inference.pareto import pareto_smoothed


@pytest.mark.parametrize("number", [5, 20, 100, 512, 4608])
@pytest.mark.parametrize("spread", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("tailed", [False, True])
def test_they_are_those_of_arviz(number, spread, tailed):
    generator = torch.Generator().manual_seed(number)
    raw = spread * torch.randn(number, generator=generator).double()
    if tailed:  # a Student t distribution of two degrees of freedom
        raw = raw / torch.empty(number).double().exponential_(generator=generator).sqrt()
    raw[::7] = -torch.inf
    expected, pareto_k = az.psislw(raw.numpy().copy())
    found, own = pareto_smoothed(raw)
    assert own == pytest.approx(float(pareto_k), abs=1e-6)
    torch.testing.assert_close(found.exp(), torch.as_tensor(expected).exp(), rtol=0, atol=1e-9)


def test_equal_weights_stay_as_they_are():
    found, own = pareto_smoothed(torch.full((8,), -3.0).double())
    assert own == -math.inf
    torch.testing.assert_close(found, torch.full((8,), 1 / 8).double().log())


def test_a_tail_too_short_has_no_finite_k():
    found, own = pareto_smoothed(torch.tensor([0.0, 1.0, 2.0]).double())
    assert own == math.inf
    torch.testing.assert_close(found.exp().sum(), torch.ones(()).double())


@pytest.mark.parametrize("ties", [68, 200])
def test_weights_that_are_bounded_by_many_equal_ones_are_reliable(ties):
    """The tail of 500 weights is the largest 68, here equal; one fewer, and there is a tail."""
    weights = torch.cat([torch.zeros(ties), -1 - torch.rand(500 - ties)]).double()
    smoothed, k = pareto_smoothed(weights)
    assert k == -math.inf
    torch.testing.assert_close(smoothed, torch.log_softmax(weights, 0))


def test_a_tail_of_equal_weights_above_others_is_not_fitted():
    weights = torch.cat([torch.zeros(30), torch.full((470,), -2.0)]).double()
    smoothed, k = pareto_smoothed(weights)
    assert k == -math.inf
    torch.testing.assert_close(smoothed, torch.log_softmax(weights, 0))

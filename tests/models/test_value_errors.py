"""Differences of action values that may be errors of the robot's network."""

import math

import pytest
import torch

from mirror_ppl.domains import get_domain
from mirror_ppl.domains.record import Record
from mirror_ppl.errors import InputError
from mirror_ppl.models import HumanModel
from mirror_ppl.models.value_errors import beyond_errors
from mirror_ppl.models.weights import load_self_model, shipped_weights


def test_differences_are_shrunk_as_the_docstring_says():
    found = beyond_errors(torch.tensor([1.0, 0.9, 0.8, -9.0]), 0.1)
    expected = [1.0, 1 - 0.1 * (1 - math.exp(-1)), 1 - 0.2 * (1 - math.exp(-4)), -9.0]
    assert found.tolist() == pytest.approx(expected, abs=1e-6)


def test_without_errors_values_stay():
    values = torch.randn(3, 4, generator=torch.Generator().manual_seed(0))
    assert beyond_errors(values, 0.0) is values
    assert beyond_errors(values, 1e-50) is values


def test_the_order_of_actions_and_the_best_value_stay():
    values = torch.randn(1000, 5, generator=torch.Generator().manual_seed(0)).double()
    found = beyond_errors(values, 0.5)
    assert torch.equal(found.argsort(-1), values.argsort(-1))
    assert torch.equal(found.amax(-1), values.amax(-1))


def test_differences_between_two_worse_actions_are_not_made_smaller():
    behind = torch.linspace(0.0708, 2, 1000).double()
    found = -beyond_errors(torch.cat([torch.zeros(1).double(), -behind]), 0.1)[1:]
    assert (found.diff() >= behind.diff() - 1e-12).all()


def test_gradients_are_finite_where_actions_are_equally_good():
    values = torch.tensor([1.0, 1.0, 0.0], requires_grad=True)
    beyond_errors(values, 0.1)[1].backward()
    assert values.grad is not None
    assert values.grad.isfinite().all()


@pytest.mark.parametrize("domain", ["driving", "search_rescue"])
def test_people_choose_by_values_without_errors_of_their_world(domain):
    self_model, _ = load_self_model(shipped_weights(domain), domain)
    belief = torch.randn(20, self_model.latent, generator=torch.Generator().manual_seed(0))
    error = get_domain(domain).record.value_error
    assert (error > 0) == (domain == "search_rescue")
    values = self_model.action_values(belief)
    found = HumanModel(self_model).action_values(belief)
    assert torch.equal(found, beyond_errors(values, error))
    assert torch.equal(found, values) == (error == 0)


@pytest.mark.parametrize("error", [-0.1, math.inf])
def test_an_impossible_error_is_refused(error):
    with pytest.raises(InputError, match=r"value_error must be from 0 to 1e\+06, not"):
        Record(value_error=error)

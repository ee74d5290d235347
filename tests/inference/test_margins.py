"""The map from standard normal numbers to a prior: margins, and what depends on what."""

import torch

from mirror_ppl.inference.margins import (
    REACH,
    PriorDependence,
    PriorMargins,
    independent,
    prior_dependence,
    prior_knots,
)


def hierarchy(number):
    """Draws ``[S, 3]``: the second has a mean and a spread by the first, the third is alone."""
    generator = torch.Generator().manual_seed(0)
    u = torch.randn(number, 3, generator=generator)
    y = u.clone()
    y[:, 1] = 0.5 + 0.8 * y[:, 0] + (0.3 * y[:, 0] - 1).exp() * u[:, 1]
    return y, u


def test_what_depends_is_taken_out():
    y, u = hierarchy(20_000)
    found = PriorDependence(*prior_dependence(y)).inv(y)
    inside = y[:, 0].abs() < REACH  # beyond, what depends is as at the edge
    found, u = found[inside], u[inside]
    # Standard errors of regression coefficients of 20,000 draws are about 1/140.
    assert (found - u).abs().quantile(0.999) < 0.2  # scales are right to some five percent
    assert (torch.corrcoef(found.T) - torch.eye(3)).abs().max() < 5 / 140


def test_it_is_a_map_with_an_inverse_and_its_density():
    y, u = hierarchy(2000)
    there = PriorDependence(*prior_dependence(y))
    u = u[:50].double()
    there = PriorDependence(there.mean.double(), there.log_scale.double())
    places = there(u)
    torch.testing.assert_close(there.inv(places), u)
    each = torch.stack([torch.autograd.functional.jacobian(there, one) for one in u])
    torch.testing.assert_close(there.log_abs_det_jacobian(u, places), each.slogdet().logabsdet)


def test_nothing_depends_where_it_is_said_so():
    u = torch.randn(20, 4)
    there = PriorDependence(*independent(4))
    torch.testing.assert_close(there(u), u)
    assert not there.log_abs_det_jacobian(u, u).any()


def test_margins_have_the_quantiles_of_draws():
    draws = torch.randn(50_000, 1, generator=torch.Generator().manual_seed(0)).exp()
    there = PriorMargins(prior_knots(draws))
    normal = torch.tensor([[-1.0], [0.0], [1.0]])
    torch.testing.assert_close(there(normal), normal.exp(), rtol=0.05, atol=0)

"""Proposals of points: kernels are densities, and leave out their own points."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_far import Far, Vector
from scipy import stats
from torch.distributions import constraints

from mirror_ppl.inference.point_proposals import Coordinates, Kernels, Whitening
from mirror_ppl.inference.weighted import tempered
from mirror_ppl.likelihood.grid import Grid
from mirror_ppl.likelihood.points import PriorPoints
from mirror_ppl.models.toy import ToyHuman


@pytest.fixture(scope="module")
def toy(self_model):
    return ToyHuman(self_model)


class Mixed(Far):
    """Sites of several kinds and supports."""

    def prior(self):
        one = torch.ones(3)
        return self.rates() | {
            "far": pyro.sample("far", dist.Normal(0.0, 1.0)),
            "share": pyro.sample("share", dist.Beta(2.0, 1.0)),
            "mix": pyro.sample("mix", dist.Dirichlet(one)),
            "kind": pyro.sample("kind", dist.Categorical(one / 3)),
        }

    def place(self, implants):
        seen = implants["share"] + implants["mix"][..., 0] + implants["kind"]
        return implants["far"] + 0.1 * seen


@torch.no_grad()
def test_kernels_are_a_density(toy):
    """Importance weights average to one, and give the prior's moments."""
    human = Mixed(toy.self_model)
    prior = PriorPoints.of(human)
    points = prior.draw(2000, 0)
    whitening = Whitening.of(Coordinates.of(human, points), points)
    likely = torch.softmax(-((points["far"].double() - 1) ** 2) * 8 - 4 * points["share"], 0)
    kernels = Kernels.around(whitening, points, torch.arange(2000), likely)
    number = 20_000
    drawn = kernels.draw(number)
    assert ((drawn["far"] - 1).abs() < 1).double().mean() > 0.8
    others = torch.arange(2000, 2000 + number)
    assert constraints.simplex.check(drawn["mix"]).all()
    weights = (prior.log_density(drawn).double() - kernels.log_density(drawn, others)).exp()
    near = ((drawn["far"] - 1).abs() < 0.5).double() * (drawn["share"] < 0.5)
    expected = (stats.norm.cdf(1.5) - stats.norm.cdf(0.5)) * 0.25  # Beta(2, 1) below .5
    found = weights * near
    error = float(found.std()) / math.sqrt(number)
    assert error < 0.1 * expected
    assert abs(float(found.mean()) - expected) < 4 * error


@torch.no_grad()
def test_points_at_a_boundary_are_none_of_the_kernels(toy):
    human = Mixed(toy.self_model)
    points = PriorPoints.of(human).draw(100, 0)
    points["mix"][7] = torch.tensor([0.0, 0.5, 0.5])
    whitening = Whitening.of(Coordinates.of(human, points), points)
    assert whitening.factor.isfinite().all()
    numbers, likely = torch.arange(100), torch.full((100,), 0.01).double()
    kernels = Kernels.around(whitening, points, numbers, likely)
    assert len(kernels.numbers) == 99 and kernels.spread.isfinite().all()
    found = kernels.log_density(points, numbers)
    assert (found == -math.inf).nonzero().flatten().tolist() == [7]


@torch.no_grad()
def test_points_do_not_count_their_own_kernels(toy):
    human = Far(toy.self_model)
    points = PriorPoints.of(human).draw(50, 0)
    whitening = Whitening.of(Coordinates.of(human, points), points)
    likely = torch.softmax(-8 * points["far"].double().abs(), 0)
    own = torch.arange(50)
    kernels = Kernels.around(whitening, points, own, likely)
    some = Grid({site: value[:1] for site, value in points.items()})
    without = own[1:]
    others = Kernels(
        whitening,
        points.chosen(without),
        without,
        kernels.log_weights[1:].log_softmax(0),
        kernels.directions,
        kernels.centres[1:],
        kernels.spread,
    )
    as_another = torch.tensor([99])
    found = kernels.log_density(some, own[:1])
    assert float(found) == pytest.approx(float(others.log_density(some, as_another)), abs=1e-9)
    assert float(kernels.log_density(some, as_another)) != pytest.approx(float(found), abs=1e-3)


@torch.no_grad()
def test_nothing_is_left_of_a_single_kernel_at_its_point(toy):
    points = PriorPoints.of(Vector(toy.self_model)).draw(50, 0)
    whitening = Whitening.of(Coordinates.of(Vector(toy.self_model), points), points)
    one, number = points.chosen(torch.tensor([3])), torch.tensor([3])
    kernels = Kernels.around(whitening, one, number, torch.ones(1).double())
    assert kernels.log_density(one, number).tolist() == [-math.inf]
    assert kernels.log_density(one, number + 1).isfinite().all()


def test_probabilities_are_tempered_as_far_as_needed():
    found = tempered(torch.tensor([0.0, -10, -20, -30]), 3.0)
    assert float(1 / found.exp().square().sum()) == pytest.approx(3, abs=1e-3)
    even = torch.full((4,), math.log(1 / 4))
    torch.testing.assert_close(tempered(even, 2.0), even)

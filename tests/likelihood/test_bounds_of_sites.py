"""What a site can be must not depend on another site; the numbers of a vector may differ."""

import copy

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch.distributions import AffineTransform, ExpTransform

from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models.toy import ToyHuman
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


class Within(ToyHuman):
    def prior(self):
        implants = super().prior()
        inner = dist.Uniform(torch.zeros_like(implants["in_sight"]), implants["in_sight"])
        return implants | {"inner": pyro.sample("inner", inner)}


class TwoWithin(ToyHuman):
    def prior(self):
        implants = super().prior()
        limits = implants["in_sight"][..., None] * torch.tensor([1.0, 2.0])
        inner = dist.Uniform(torch.zeros_like(limits), limits).to_event(1)
        return implants | {"inner": pyro.sample("inner", inner)}


class OfSomePeople(ToyHuman):
    """Four of five people have the same bounds."""

    def prior(self):
        far = pyro.sample("far", dist.Bernoulli(torch.tensor(0.2)))
        return super().prior() | {"inner": pyro.sample("inner", dist.Uniform(0.0, 1 + 2 * far))}


class Counted(ToyHuman):
    def prior(self):
        far = pyro.sample("far", dist.Categorical(torch.tensor([0.5, 0.5])))
        inner = pyro.sample("inner", dist.Binomial(1.0 + far, torch.tensor(0.5)))
        return super().prior() | {"inner": inner}


class Moved(ToyHuman):
    """From 1 to 3, which the transformed distribution does not say."""

    def prior(self):
        share = dist.Beta(torch.tensor(2.0), torch.tensor(2.0))
        moved = dist.TransformedDistribution(share, [AffineTransform(1.0, 2.0)])
        return super().prior() | {"inner": pyro.sample("inner", moved)}


class Positive(ToyHuman):
    def prior(self):
        log = dist.Normal(torch.tensor(0.0), torch.tensor(1.0))
        scale = dist.TransformedDistribution(log, [ExpTransform()])
        parts = pyro.sample("parts", dist.Dirichlet(torch.full((4,), 0.5)))
        return super().prior() | {"inner": pyro.sample("inner", scale), "parts": parts}

    def act(self, implants, belief, values):
        found = super().act(implants, belief, values)
        inner = implants["inner"] * implants["parts"][..., 0]
        return torch.log_softmax(found + torch.stack([inner, -inner], -1), -1)


class Narrow(ToyHuman):
    """Far from these draws, densities are rounded to 0."""

    def prior(self):
        narrow = pyro.sample("narrow", dist.Gumbel(torch.tensor(3.0), torch.tensor(0.03)))
        steep = pyro.sample("steep", dist.Weibull(torch.tensor(0.5), torch.tensor(25.0)))
        return super().prior() | {"narrow": narrow, "steep": steep}

    def act(self, implants, belief, values):
        found = super().act(implants, belief, values)
        both = implants["narrow"] + implants["steep"]
        return torch.log_softmax(found + torch.stack([both, -both], -1), -1)


class Fixed(ToyHuman):
    def prior(self):
        inner = dist.Uniform(torch.zeros(2), torch.tensor([1.0, 2.0])).to_event(1)
        return super().prior() | {"inner": pyro.sample("inner", inner)}

    def act(self, implants, belief, values):
        found = super().act(implants, belief, values)
        inner = implants["inner"].sum(-1)
        return torch.log_softmax(found + torch.stack([inner, -inner], -1), -1)


@pytest.mark.parametrize("kind", [Within, TwoWithin, OfSomePeople, Counted])
def test_bounds_that_depend_on_another_site_are_refused(kind, self_model):
    with pytest.raises(HumanModelError, match='what "inner" can be depends on another site'):
        check_contract(kind(self_model))


def test_supports_that_allow_too_much_are_refused(self_model):
    with pytest.raises(HumanModelError, match='"inner" has no density at some values that its'):
        check_contract(Moved(self_model))


@pytest.mark.parametrize("kind", [Fixed, Positive, Narrow])
def test_bounds_of_the_numbers_of_a_vector_may_differ(kind, self_model):
    check_contract(kind(self_model))


def test_numbers_of_64_bits_are_refused(self_model):
    with pytest.raises(HumanModelError, match=r"parameters are of torch.float64, expected"):
        check_contract(Fixed(copy.deepcopy(self_model).double()))

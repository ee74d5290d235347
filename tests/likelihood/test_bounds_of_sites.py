"""What a site can be must not depend on another site; the numbers of a vector may differ."""

import pyro
import pyro.distributions as dist
import pytest
import torch

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


class Fixed(ToyHuman):
    def prior(self):
        inner = dist.Uniform(torch.zeros(2), torch.tensor([1.0, 2.0])).to_event(1)
        return super().prior() | {"inner": pyro.sample("inner", inner)}

    def act(self, implants, belief, values):
        found = super().act(implants, belief, values)
        inner = implants["inner"].sum(-1)
        return torch.log_softmax(found + torch.stack([inner, -inner], -1), -1)


@pytest.mark.parametrize("kind", [Within, TwoWithin])
def test_bounds_that_depend_on_another_site_are_refused(kind, self_model):
    with pytest.raises(HumanModelError, match='what "inner" can be depends on another site'):
        check_contract(kind(self_model))


def test_bounds_of_the_numbers_of_a_vector_may_differ(self_model):
    check_contract(Fixed(self_model))

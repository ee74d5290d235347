"""Toy people whose reach is an interval of a continuous site, for exact answers."""

import math

import pyro
import pyro.distributions as dist
import torch
from pyro import poutine
from scipy import stats

from mirror_ppl.models.toy import ToyHuman

SHARES = torch.tensor([0.97, 0.02, 0.006, 0.002, 0.001, 0.0007, 0.0003], dtype=torch.double)
"""Prior probabilities of reaches: of 8,192 points, 8 have that of the recorded person."""
CUTS = torch.tensor(stats.norm.ppf(SHARES.cumsum(0)[:-1]))
TRUE = {"reach": torch.tensor([[4]]), "in_sight": torch.tensor([[0.9]])}


class Far(ToyHuman):
    """The toy, whose reach is an interval of a continuous site."""

    def rates(self):
        with poutine.block(hide=["reach"]):
            return {name: value for name, value in super().prior().items() if name != "reach"}

    def prior(self):
        return self.rates() | {"far": pyro.sample("far", dist.Normal(0.0, 1.0))}

    def place(self, implants):
        return implants["far"]

    def perceive(self, implants, knowledge, observation, told, step):
        reach = {"reach": torch.bucketize(self.place(implants).double(), CUTS)}
        return super().perceive(reach, knowledge, observation, told, step)


class Vector(Far):
    """The reach depends on the sum of twelve numbers."""

    def prior(self):
        return self.rates() | {
            "far": pyro.sample("far", dist.Normal(torch.zeros(12), 1.0).to_event(1))
        }

    def place(self, implants):
        return implants["far"].sum(-1) / math.sqrt(12)


class Rare(Vector):
    """Far reaches are as rare as the instance says."""

    beyond = 0.0

    def place(self, implants):
        return super().place(implants) - self.beyond + CUTS[3]


class Glasses(Far):
    """Without glasses a person sees nothing."""

    def prior(self):
        return super().prior() | {
            "glasses": pyro.sample("glasses", dist.Categorical(torch.tensor([0.7, 0.3])))
        }

    def place(self, implants):
        return torch.where(implants["glasses"] > 0, implants["far"], -9.0)


class Scaled(Far):
    """The spread of people is inferred, too; nothing else reads it."""

    def prior(self):
        spread = pyro.sample("spread", dist.LogNormal(-0.5, 0.5))
        return self.rates() | {"far": pyro.sample("far", dist.Normal(0.0, spread))}


class Able(Far):
    """Who acts well sees far: the reach depends on a site that ``act`` reads."""

    def prior(self):
        implants = self.rates()
        far = dist.Normal(2 * implants["in_sight"] - 1, 1.0)
        return implants | {"far": pyro.sample("far", far)}

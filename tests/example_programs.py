"""Human models with all that Pyro counts besides the sites of the package's own."""

import sys

import pyro
import pyro.distributions as dist
import torch
from paths import EXAMPLES
from pyro import poutine

from mirror_ppl.models import HumanModel
from mirror_ppl.models.variants import VARIANTS

sys.path.insert(0, str(EXAMPLES))
from distracted import DistractedPerson  # noqa: E402
from late_reactions import LatePerson  # noqa: E402


class FactorInPrior(HumanModel):
    def prior(self):
        implants = super().prior()
        pyro.factor("seldom", -50 * implants["lapse"])
        return implants


class FactorOfSight(HumanModel):
    def prior(self):
        implants = super().prior()
        pyro.factor("near", -implants["sight_front_own"] * 0.7 + implants["assumes_clear"])
        return implants


class Questionnaire(HumanModel):
    def prior(self):
        implants = super().prior()
        answer = dist.Normal(implants["consistency"], 0.5)
        pyro.sample("questionnaire", answer, obs=torch.tensor(1.0))
        return implants


class Chart(HumanModel):
    """An eye chart, whose letters people name as far as they see."""

    def prior(self):
        implants = super().prior()
        rate = 0.1 + 0.1 * implants["sight_front_own"]
        pyro.sample("chart", dist.Binomial(10, rate), obs=torch.tensor(7.0))
        return implants


class ScaledPrior(HumanModel):
    def prior(self):
        with poutine.scale(scale=0.3):
            return super().prior()


class MaskedPrior(HumanModel):
    def prior(self):
        implants = super().prior()
        with poutine.mask(mask=False):
            pyro.factor("nothing", 100 * implants["lapse"])
        with poutine.mask(mask=implants["consistency"] > 2):
            pyro.factor("strict", -30 * implants["lapse"])
        return implants


class ObservedInAct(HumanModel):
    """A person who says at each step how well they like it."""

    def act(self, implants, belief, values):
        spread = values.max(-1).values - values.min(-1).values
        with poutine.scale(scale=0.5):
            pyro.sample("mood", dist.Normal(spread, 2.0), obs=torch.tensor(0.3))
        pyro.factor("calm", -0.1 * implants["consistency"])
        return super().act(implants, belief, values)


class InRounds(DistractedPerson):
    """A person who says after each round whether they were distracted."""

    def round_latents(self, implants):
        with poutine.scale(scale=0.8):
            latents = super().round_latents(implants)
        sure = 0.2 + 0.6 * latents["away"]
        pyro.sample("said", dist.Bernoulli(sure), obs=torch.tensor(1.0))
        pyro.factor("sleepy", 0.5 * implants["distracted"])
        return latents


class ObservedWhileAway(DistractedPerson):
    """A distracted person who says at each step what they see."""

    def act(self, implants, belief, values):
        pyro.factor("sees", 3 * belief[..., 0] + 0 * implants["lapse"])
        pyro.sample("mood", dist.Normal(values.sum(-1), 2.0), obs=torch.tensor(0.3))
        return super().act(implants, belief, values)


ENUMERATED = [HumanModel, VARIANTS["one-radius"], LatePerson, DistractedPerson, Chart]
"""Programs that Pyro itself enumerates in the tests."""
PROGRAMS = [
    *(VARIANTS[name] for name in ("perceptual-only", "policy-only", "no-implants")),
    *(FactorInPrior, FactorOfSight, Questionnaire, ScaledPrior, MaskedPrior, ObservedInAct),
    *(*ENUMERATED, InRounds, ObservedWhileAway),
]

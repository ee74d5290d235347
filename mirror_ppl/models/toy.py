"""A toy human model with a posterior in closed form, to validate every engine.

::

    reach       ~ Categorical                       over the domain's bins
    in_sight    ~ Beta(2, 2),  otherwise ~ Beta(1, 4)
    a_t         ~ Bernoulli(in_sight) if an item is within reach at t, else Bernoulli(otherwise)

Given the reach, both rates have Beta posteriors, and the evidence of the reach is beta-binomial.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.view import View

RATES = {"in_sight": (2.0, 2.0), "otherwise": (1.0, 4.0)}
"""Priors of the rates of the second action, by site."""


class ToyHuman(HumanModel):
    """A person who takes the second action at one rate with an item in sight, else at another.

    For domains with two actions. The networks of its self-model are not used.
    """

    def prior(self) -> dict[str, Tensor]:
        """Sample ``reach``, an index into the domain's bins, and the two rates."""
        like = next(self.self_model.parameters())
        bins = like.new_ones(len(self.domain.reach_bins))
        implants = {"reach": pyro.sample("reach", dist.Categorical(bins / bins.sum()))}
        for site, (one, two) in RATES.items():
            rate = dist.Beta(like.new_tensor(one), like.new_tensor(two))
            implants[site] = pyro.sample(site, rate)
        return implants

    def perceive(
        self,
        implants: Implants,
        knowledge: Any,
        observation: Observation,
        told: Visibility,
        step: int,
    ) -> tuple[View, Any]:
        """Return the items within reach; nothing is remembered."""
        del told, step
        _, distance = self.domain.distance(observation)
        bins = torch.tensor(self.domain.reach_bins, device=distance.device)
        return View({"visual": distance <= bins[implants["reach"]][..., None]}), knowledge

    def evidence(self, view: View, observation: Observation) -> Tensor:
        """Return 1 where an item is in sight, else 0, ``[..., 1]``."""
        del observation
        like = next(self.self_model.parameters())
        return view.visible["visual"].any(-1, keepdim=True).to(like)

    def believe(
        self, belief: Tensor, evidence: Tensor, action: Tensor, still: Tensor | None = None
    ) -> Tensor:
        """Return the evidence in the first dimension of the belief ``[..., Z]``."""
        del action, still
        return torch.nn.functional.pad(evidence, [0, belief.shape[-1] - 1])

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Return log-probabilities ``[..., P, B, 2]``."""
        del values
        rate = torch.where(belief[..., 0] > 0, implants["in_sight"], implants["otherwise"])
        return torch.stack([torch.log1p(-rate), torch.log(rate)], -1)


@dataclass(frozen=True)
class ToyPosterior:
    """The posterior of toy people.

    Attributes:
        reach: probability of each bin ``[P, n]``.
        rates: parameters of the Beta posterior of each rate given the bin, ``[P, n, 2]``.
        log_evidence: log marginal likelihood of the recorded actions ``[P]``, nats.
    """

    reach: Tensor
    rates: dict[str, Tensor]
    log_evidence: Tensor

    def mean(self, site: str) -> Tensor:
        """Posterior mean of a rate ``[P]``."""
        one, two = self.rates[site].unbind(-1)
        return (self.reach * one / (one + two)).sum(-1)

    def variance(self, site: str) -> Tensor:
        """Posterior variance of a rate ``[P]``."""
        one, two = self.rates[site].unbind(-1)
        total = one + two
        second = one * (one + 1) / (total * (total + 1))
        return (self.reach * second).sum(-1) - self.mean(site).square()


@torch.no_grad()
def toy_posterior(human: ToyHuman, demonstrations: Demonstrations) -> ToyPosterior:
    """Compute the exact posterior of recordings.

    Args:
        human: the toy model.
        demonstrations: rounds of P people; messages are ignored.
    """
    domain, steps = human.domain, demonstrations.shape[2]
    observation = {n: value[:, :, :steps] for n, value in demonstrations.observation().items()}
    _, distance = domain.distance(observation)
    bins = torch.tensor(domain.reach_bins)
    seen = (distance.amin(-1)[..., None] <= bins).double()  # [P, B, T, n]
    real = demonstrations.mask[..., None].double()
    second = (demonstrations.actions == 1)[..., None].double() * real
    first = real - second
    evidence = torch.zeros(demonstrations.num_people, len(bins), dtype=torch.double)
    rates = {}
    for (site, prior), when in zip(RATES.items(), (seen, 1 - seen), strict=True):
        one = prior[0] + (second * when).sum((1, 2))
        two = prior[1] + (first * when).sum((1, 2))
        evidence += _log_beta(one, two) - _log_beta(*torch.tensor(prior, dtype=torch.double))
        rates[site] = torch.stack([one, two], -1)
    log_evidence = evidence.logsumexp(-1) - torch.tensor(len(bins)).log()
    return ToyPosterior(torch.softmax(evidence, -1), rates, log_evidence)


def _log_beta(one: Tensor, two: Tensor) -> Tensor:
    return torch.lgamma(one) + torch.lgamma(two) - torch.lgamma(one + two)

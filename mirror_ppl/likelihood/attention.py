"""Weighted samples of the latents of a round (attention), to sum them out approximately.

A person's attention ``m`` in a round cannot be enumerated: its sites have too many combinations of
values. Sums over them, ``sum_m p(m | psi) f(m)``, are estimated from G values, the same for all
``psi``, so that the estimate is smooth in ``psi``. Values are drawn without replacement from a
product ``q`` of one distribution for each site, and each is weighted by the inverse of its
inclusion probability ``pi(m)``::

    sum_m p(m | psi) f(m)  ~=  sum_g w_g f(m_g),    w_g = p(m_g | psi) / pi(m_g)

The estimate is unbiased for every ``q``, and exact if all combinations are kept. Normalizing it by
``sum_g w_g`` would bias it: since ``q`` depends on the recorded actions, it would favour a ``psi``
under which few of these values are probable.

Values of high probability are kept with certainty, the others by systematic resampling (Fearnhead
and Clifford, *On-line inference for hidden Markov models via particle filters*, 2003), site by
site. The G values are then thinned in the same way to those that explain the recorded actions.
``pi`` is the product of the probabilities with which a value was kept at each stage.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.sites import latent_sites
from mirror_ppl.randomness import forked, seed_everything

VALUES, KEPT = 512, 96
"""Number of sampled values of attention per round, and how many are kept given the actions."""
ANY_WAY, ANY_VALUE = 0.08, 0.02
"""Shares of ``q`` that follow the prior and a uniform distribution."""
ANY_USE = 0.05
"""Share of the kept values that are chosen uniformly."""


@dataclass(frozen=True)
class AttentionValues:
    """G weighted values of the round latents of one round.

    Attributes:
        values: values of each site ``[G]``.
        log_weights: ``-log pi``, ``[G]``.
        kept: indices of the values that are evaluated ``[G']``.
        log_kept: log-probability with which each of these was kept ``[G']``.
        covariates: covariates of the round, see `HumanModel.covariates`.
    """

    values: dict[str, Tensor]
    log_weights: Tensor
    kept: Tensor
    log_kept: Tensor
    covariates: Mapping[str, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.log_weights)

    def thinned(self, useful: Tensor, number: int, seed: int) -> AttentionValues:
        """Keep ``number`` of the G values, sampled by their usefulness ``[G]``, which sums to 1."""
        generator = torch.Generator(useful.device).manual_seed(seed)
        shares = (1 - ANY_USE) * useful + ANY_USE / len(self)
        kept, log_kept = _resampled(shares.double().log(), number, generator)
        return replace(self, kept=kept, log_kept=log_kept.to(useful.dtype))


def attention_sites(human: HumanModel) -> dict[str, Tensor]:
    """Supports ``[n]`` of the sites of a human model's ``round_latents``, by name."""
    if not human.has_round_latents:
        return {}
    with forked(), pyro.plate("person", 1, dim=-2):
        nodes = attention_nodes(human, human.prior())
    return {
        name: node["fn"].enumerate_support(expand=False).flatten() for name, node in nodes.items()
    }


def attention_nodes(human: HumanModel, implants: Mapping[str, Tensor]) -> dict[str, Any]:
    """Trace nodes of the sites of attention in one round; runs inside the person plate."""
    with poutine.block(), poutine.trace() as trace, pyro.plate("round", 1, dim=-1):
        human.round_latents(implants)
    return latent_sites(trace.trace)


def site_probabilities(
    human: HumanModel,
    policies: Mapping[str, Tensor],
    weights: Tensor | None = None,
    covariates: Mapping[str, Tensor] | None = None,
) -> dict[str, Tensor]:
    """Probability of each value of each site of attention, ``[n]``, averaged over draws.

    Args:
        human: the model of people.
        policies: draws ``[W, 1, 1, ...]`` of implants; missing sites are sampled.
        weights: weights of the draws ``[W]``; equal by default.
        covariates: covariates of the round, see `HumanModel.covariates`.
    """
    number = len(next(iter(policies.values())))
    with (
        forked(),
        poutine.block(),
        poutine.condition(data=dict(policies)),
        pyro.plate("policy", number, dim=-3),
        pyro.plate("person", 1, dim=-2),
    ):
        seed_everything(0)
        nodes = attention_nodes(human, {**human.prior(), **(covariates or {})})
    found = {}
    for name, node in nodes.items():
        support = node["fn"].enumerate_support(expand=False)
        probabilities = node["fn"].log_prob(support).exp().reshape(len(support), -1)  # [n, W]
        probabilities = probabilities.expand(-1, number)
        found[name] = probabilities.mean(-1) if weights is None else probabilities @ weights
    return found


def choose_values(
    supports: Mapping[str, Tensor],
    probabilities: Mapping[str, Tensor],
    number: int,
    generator: torch.Generator,
) -> AttentionValues:
    """Draw values from the product of distributions, without replacement.

    Args:
        supports: support of each site ``[n]``.
        probabilities: probabilities of these values ``[n]``, none of them 0.
        number: number of values G; fewer if there are fewer combinations.
        generator: source of randomness.
    """
    device = generator.device
    places = torch.zeros(1, 0, dtype=torch.long, device=device)
    log_mass = torch.zeros(1, dtype=torch.double, device=device)
    log_chosen = torch.zeros(1, dtype=torch.double, device=device)
    for own in probabilities.values():
        size = len(own)
        places = torch.cat(
            [
                places.repeat_interleave(size, 0),
                torch.arange(size, device=device).repeat(len(places))[:, None],
            ],
            1,
        )
        log_mass = (log_mass[:, None] + own.double().log()).flatten()
        log_chosen = log_chosen.repeat_interleave(size)
        kept, log_kept = _resampled(log_mass - log_chosen, number, generator)
        places, log_mass = places[kept], log_mass[kept]
        log_chosen = log_chosen[kept] + log_kept
    values = {
        name: support[place]
        for (name, support), place in zip(supports.items(), places.T, strict=True)
    }
    log_weights = -log_chosen.to(next(iter(probabilities.values())).dtype)
    everything = torch.arange(len(log_weights), device=device)
    return AttentionValues(values, log_weights, everything, torch.zeros_like(log_weights))


def _resampled(
    log_weights: Tensor, number: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Resample ``number`` of N without replacement: indices, and log inclusion probabilities."""
    if len(log_weights) <= number:
        return torch.arange(len(log_weights), device=log_weights.device), log_weights * 0
    weights = torch.softmax(log_weights, 0)
    # The probability is min(1, scale * weight), with the scale that adds up to the number.
    ordered = weights.sort(descending=True).values
    certain = torch.arange(number, device=weights.device)
    rest = 1 - ordered.cumsum(0)[:number] + ordered[:number]  # left if so many are certain
    scale = (number - certain) / rest
    enough = scale * ordered[:number] <= 1
    scale = scale[int(enough.long().argmax())] if bool(enough.any()) else scale[-1]
    probability = (scale * weights).clamp(max=1)
    ladder = probability.cumsum(0) + torch.rand((), generator=generator, device=weights.device)
    steps = ladder.floor()
    kept = (steps.diff(prepend=steps.new_zeros(1)) >= 1).nonzero().squeeze(-1)
    return kept, probability[kept].log()


class Proposal:
    """Proposes values of attention for the rounds of a person, one by one.

    Args:
        human: the model of people; it has round latents.
        anybody: draws ``[W, 1, 1, ...]`` of implants from the prior.
        likely: approximate posterior draws of this person, if available.
        number: number of values G.
    """

    def __init__(
        self,
        human: HumanModel,
        anybody: Mapping[str, Tensor],
        likely: Mapping[str, Tensor] | None,
        number: int = VALUES,
    ) -> None:
        self.human = human
        self.supports = attention_sites(human)
        self.number = number
        self.anybody = dict(anybody)
        self._found: dict[tuple, dict[str, Tensor]] = {}
        self.likely = likely

    def values(
        self,
        weights: Tensor | None,
        seed: int,
        covariates: Mapping[str, Tensor] | None = None,
        log_proposal: Mapping[str, Tensor] | None = None,
    ) -> AttentionValues:
        """Sample values for a round.

        Args:
            weights: weights of the prior draws given the rounds so far, ``[W]``; ignored if
                ``likely`` was given.
            seed: seed of the draws.
            covariates: covariates of the round, see `HumanModel.covariates`.
            log_proposal: proposal given the recorded actions, see `HumanModel.log_proposal`.
        """
        covariates = dict(covariates or {})
        prior = self._known("anybody", self.anybody, covariates)
        likely = prior
        if self.likely is not None:
            likely = self._known("likely", self.likely, covariates)
        elif weights is not None:
            likely = site_probabilities(self.human, self.anybody, weights, covariates)
        probabilities = {}
        for name, own in likely.items():
            own = (1 - ANY_WAY) * own + ANY_WAY * prior[name]
            if log_proposal and name in log_proposal:
                own = torch.softmax(own.log() + log_proposal[name].to(own), 0)
            probabilities[name] = (1 - ANY_VALUE) * own + ANY_VALUE / len(own)
        generator = torch.Generator(next(iter(probabilities.values())).device).manual_seed(seed)
        chosen = choose_values(self.supports, probabilities, self.number, generator)
        return replace(chosen, covariates=covariates)

    def _known(
        self, whom: str, draws: Mapping[str, Tensor], covariates: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Probabilities of values, cached by covariates."""
        key = (whom, *((name, *value.flatten().tolist()) for name, value in covariates.items()))
        if key not in self._found:
            self._found[key] = site_probabilities(self.human, draws, None, covariates)
        return self._found[key]

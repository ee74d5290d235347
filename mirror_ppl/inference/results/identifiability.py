"""Identifiability of perceptual implants: posterior entropy and expected information gain.

Unusual actions may be due to perception or to policy. With posterior draws ``psi_s`` of the policy
implants and the exact posterior ``p(m | psi_s, actions)`` of the perceptual implants given each,

    entropy             H[ mean_s p(m | psi_s, actions) ]
    shared with policy  entropy - mean_s H[ p(m | psi_s, actions) ]

in nats. The second is the posterior mutual information of perceptual and policy implants: the
reduction of entropy if the policy were known. The expected information gain of a further round is

    H[ p(m | actions) ] - E H[ p(m | actions, actions of that round) ]

for each scenario, with the policy marginalized and the expectation over rounds that the model
simulates (Lindley, *On a measure of the information provided by an experiment*, 1956).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.inference.population.pooling import Pooling, Population
from mirror_ppl.likelihood.combinations import needs_points, perceived_sites
from mirror_ppl.likelihood.enumeration import (
    acts_on_beliefs,
    conditioned,
    log_joints,
)
from mirror_ppl.likelihood.grid import combination_number
from mirror_ppl.likelihood.round_views import Rounds
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table, rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.human import HumanModel, has_own_program
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.randomness import person_seed

NEGLIGIBLE = 0.005
"""Nats below which entropies and information gains count as 0; printed as 0.00."""
POLICIES = 48
"""Posterior draws of the policy implants."""
COMBINATIONS = 128
"""Largest number of combinations of perceptual implants in information gains."""
FEW = 64
"""If draws have at most this many distinct combinations, only these are considered,"""
ENOUGH = 3
"""provided that there are this many times as many draws."""

VALUES = 64
"""Sampled values of attention per round."""


@dataclass(frozen=True)
class Identifiability:
    """Identifiability of P people's perceptual implants, in nats.

    Attributes:
        sites: the D discrete implants that perception reads.
        entropy: posterior entropy of each ``[P, D]``.
        shared: part of it that is shared with the policy implants ``[P, D]``.
        all_entropy, all_shared: entropy and shared part of all sites jointly ``[P]``.
        information: expected information gain of one more round in each of the domain's N
            scenarios, about all sites jointly, ``[P, N]``; empty if no round was simulated. An
            estimate from few rounds may be negative.
        information_error: its standard error over simulated rounds; NaN for a single round.
    """

    sites: tuple[str, ...]
    entropy: Tensor
    shared: Tensor
    all_entropy: Tensor
    all_shared: Tensor
    information: Tensor
    information_error: Tensor

    @classmethod
    def joined(cls, parts: Sequence[Mapping[str, Any]]) -> Identifiability:
        """Concatenate the attributes of several people."""
        tensors = [name for name in parts[0] if name != "sites"]
        return cls(
            tuple(parts[0]["sites"]),
            **{name: torch.cat([part[name] for part in parts]) for name in tensors},
        )

    @property
    def nothing(self) -> bool:
        """True if all joint entropies and information gains are negligible."""
        told = torch.cat([self.all_entropy.flatten(), self.information.flatten()])
        return bool((told < NEGLIGIBLE).all())

    def of(self, person: int, scenarios: Sequence[str]) -> dict[str, Any]:
        """Identifiability of one person, as stored in ``summary.json``."""
        entropy, shared = (part[person].tolist() for part in (self.entropy, self.shared))
        information, error = (
            part[person].tolist() for part in (self.information, self.information_error)
        )
        return {
            "entropy": dict(zip(self.sites, entropy, strict=True))
            | {"together": float(self.all_entropy[person])},
            "shared_with_policy": dict(zip(self.sites, shared, strict=True))
            | {"together": float(self.all_shared[person])},
            "scenarios": {
                name: {"expected": expected, "error": None if math.isnan(error) else error}
                for name, expected, error in zip(
                    scenarios[: len(information)], information, error, strict=True
                )
            },
        }


@torch.no_grad()
def identify(
    human: HumanModel,
    train: Demonstrations,
    draws: Mapping[str, Tensor],
    seed: int,
    population: Population | None = None,
    combinations: Sequence[Tensor] = (),
    rounds: int = 8,
) -> Identifiability | None:
    """Compute the identifiability of people's perceptual implants after a fit.

    Args:
        human: the model of people.
        train: training rounds.
        draws: posterior draws ``[S, P, 1, ...]``, not autocorrelated.
        seed: seed of the simulated rounds.
        population: posterior of the population, if people were pooled.
        combinations: probable combinations of each person's discrete implants, if inference found
            them. They are found anew otherwise, which takes most of the time.
        rounds: simulated rounds in each scenario; 0 for none.

    Returns:
        The identifiability; ``None`` for models in which perception reads no site or a continuous
        one, in which percepts affect actions other than through beliefs, or with a program of their
        own.
    """
    if has_own_program(human) or needs_points(human):
        return None
    sizes = {site: len(support) for site, support in perceived_sites(human).items()}
    if not sizes:
        return None
    held, people = next(iter(draws.values())).shape[:2]
    chosen = torch.linspace(0, held - 1, min(held, POLICIES)).round().long()
    found: list[tuple[Tensor, ...]] = []
    pooling = None if population is None else Pooling(human)
    for person in range(people):
        own = {name: value[:, person : person + 1] for name, value in draws.items()}
        drawn = combination_number({site: own[site][:, 0, 0] for site in sizes}, sizes)
        one = train.select_people([person])
        candidates = drawn.unique()
        if len(candidates) <= FEW and ENOUGH * len(candidates) <= held:
            table = build_view_table(human, one, [candidates], likely=own, values=VALUES)
        else:  # too few draws to estimate the support
            known = combinations[person : person + 1] or None
            table = build_view_table(human, one, known, Screening(), likely=own, values=VALUES)
            candidates = table.possible[0].nonzero().squeeze(-1)
        if not acts_on_beliefs(human, table.sites):
            return None
        policy = {name: value[chosen] for name, value in own.items() if name not in sizes}
        joint = log_joints(human, table, policy, candidates)[:, 0]
        grid = table.grid.chosen(candidates)
        if population is not None and pooling is not None:
            # The mean over the population, which is independent of this person's policy draws.
            probabilities = {
                site: value.mean(0, keepdim=True).expand(len(chosen), *value.shape[1:])
                for site, value in population.probabilities.items()
            }
            joint = joint + _instead_of_prior(grid, probabilities, pooling)
        weights = torch.log_softmax(joint, -1)  # [S, C]
        told = (weights.new_zeros(0),) * 2
        if rounds:
            # Each person has their own worlds, so that averages over people use many.
            generator = torch.Generator(weights.device).manual_seed(
                person_seed(seed, train.people[person])
            )
            some, pairs = _represented(weights, generator)
            told = _information(
                human,
                pairs,
                candidates[some],
                {site: value[some] for site, value in grid.items()},
                policy,
                train.setting,
                rounds,
                generator,
            )
        found.append((*_entropies(weights, grid), *told))
    return Identifiability(tuple(sizes), *(torch.stack(part) for part in zip(*found, strict=True)))


def _instead_of_prior(
    grid: Mapping[str, Tensor], probabilities: Mapping[str, Tensor], pooling: Pooling
) -> Tensor:
    """Log ratio ``[S, C]`` of the population's prior of combinations to the model's own.

    Sites that are not part of the population keep their prior.
    """
    total = torch.zeros(())
    for site, support in pooling.supports.items():
        if site in grid:
            same = grid[site][:, None] == support
            ratio = (probabilities[site] / pooling.prior_probabilities[site]).log()
            # Values that are impossible under the prior have probability 0.
            ratio = torch.where(same.any(-1), ratio[:, same.long().argmax(-1)], -torch.inf)
            total = total + ratio
    return total


def _entropies(
    weights: Tensor, grid: Mapping[str, Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Entropies and their parts shared with policy, of each site ``[D]`` and of all jointly."""
    entropy, shared = [], []
    for value in grid.values():
        values = value.unique()
        member = (value[:, None] == values).to(weights)
        pair = _entropy_and_shared(weights.exp() @ member)
        entropy.append(pair[0])
        shared.append(pair[1])
    return torch.stack(entropy), torch.stack(shared), *_entropy_and_shared(weights.exp())


def _entropy_and_shared(probability: Tensor) -> tuple[Tensor, Tensor]:
    """Entropy of the mean of conditionals ``[S, n]``, and its part shared with policy."""
    total = _entropy(probability.mean(0))
    return total, (total - _entropy(probability).mean()).clamp(min=0)


def _entropy(probability: Tensor) -> Tensor:
    return torch.special.entr(probability).sum(-1)


def _represented(weights: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Representative combinations, and their log weights ``[S, C']`` with each policy.

    All of them if they are few; else a sample, weighted by frequency. The weights of all pairs sum
    to 1.
    """
    number = weights.shape[-1]
    if number <= COMBINATIONS:
        return torch.arange(number, device=weights.device), weights - math.log(len(weights))
    drawn = torch.multinomial(
        weights.exp().mean(0), COMBINATIONS, replacement=True, generator=generator
    )
    some, counts = drawn.unique(return_counts=True)
    given = torch.log_softmax(weights[:, some], 0)
    return some, given + (counts / COMBINATIONS).log()


def _information(
    human: HumanModel,
    pairs: Tensor,
    candidates: Tensor,
    grid: Mapping[str, Tensor],
    policy: Mapping[str, Tensor],
    setting: str,
    rounds: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Expected information gain of a round in each scenario ``[N]``, nats; standard error."""
    domain = human.domain
    number = len(domain.scenarios)
    # Players are pairs of policy and combination, by probability, the same in each scenario.
    players = torch.multinomial(
        pairs.exp().flatten(), rounds, replacement=True, generator=generator
    ).repeat(number)
    draw, which = players // len(candidates), players % len(candidates)
    implants = {name: value[draw, 0] for name, value in policy.items()}
    implants |= {site: value[which][:, None] for site, value in grid.items()}
    scenario = torch.arange(number, device=pairs.device).repeat_interleave(rounds)
    played = play_rounds(human, implants, 1, setting, generator, scenario)
    builder = ViewTableBuilder(human, None, candidates, policy, VALUES)
    builder.add(Rounds.joined([rounds_of(played, player) for player in range(len(players))]))
    table = builder.table()
    with conditioned(policy, len(pairs), 1):
        likelihood = log_likelihoods(human, human.prior(), table)
    likelihood = likelihood.expand(len(pairs), 1, -1)[:, 0]  # [S, U]
    joint = likelihood[:, table.index[0][:, candidates]] + pairs[:, None]  # [S, R, C]
    after = torch.softmax(torch.logsumexp(joint, 0), -1)  # [R, C]
    each = (_entropy(pairs.exp().sum(0)) - _entropy(after)).view(number, rounds)
    if rounds == 1:
        return each[:, 0], torch.full_like(each[:, 0], math.nan)
    return each.mean(-1), each.std(-1) / math.sqrt(rounds)

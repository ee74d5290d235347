"""What a fit leaves open: does blindness hide behind policy, and which rounds would tell?

Somebody who acts oddly may not see, or may decide oddly. With posterior draws ``psi_s`` of how a
person decides and the exact ``p(m | psi_s, actions)`` of what they see under each of them,

    open about m          H[ mean_s p(m | psi_s, actions) ]
    hangs on the policy   open - mean_s H[ p(m | psi_s, actions) ]

in nats: the second is the mutual information of the two in the posterior, what one would learn of
their sight if one knew how they decide. A round that is still to be recorded, in a scenario, tells

    H[ p(m | actions) ] - E H[ p(m | actions, actions of that round) ]

of what they see whatever their policy, the expectation over rounds that the model itself plays
(Lindley, *On a measure of the information provided by an experiment*, 1956).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.inference.population.pooling import Pooling, Population
from mirror_ppl.likelihood.combinations import perceived_sites
from mirror_ppl.likelihood.enumeration import acts_on_beliefs, combination_values, log_joints
from mirror_ppl.likelihood.round_views import Rounds
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table, rounds_of
from mirror_ppl.likelihood.view_table import combination_number
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.human import HumanModel, has_own_program
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.progress import Report, silent

NEGLIGIBLE = 0.005
"""Nats below which nothing is open; they are told as 0.00."""
POLICIES = 48
"""Posterior draws of how a person decides."""
COMBINATIONS = 128
"""Combinations of what they may see between which rounds are to tell, at most."""
FEW = 64
"""Combinations among the draws up to which no others are looked at, if there are ..."""
ENOUGH = 3
"""... so many times as many draws."""

VALUES = 64
"""Values of attention in a round, where it differs from round to round."""


@dataclass(frozen=True)
class Identifiability:
    """What is open about P people, in nats.

    Attributes:
        sites: the discrete implants that perception reads; D of them.
        entropy: open about each ``[P, D]``.
        shared: of it, what hangs on how they decide ``[P, D]``.
        all_entropy, all_shared: the same of all of them together ``[P]``.
        information: expected from one more round in each of the domain's N scenarios, about all
            of them together, ``[P, N]``; empty if no round was played.
            What is expected is never negative; what is found of it, of a few rounds, may be.
        information_error: its standard error, of the rounds that were played; NaN if it was one.
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
        """Of the people of all parts, of each of which these are the attributes."""
        tensors = [name for name in parts[0] if name != "sites"]
        return cls(
            tuple(parts[0]["sites"]),
            **{name: torch.cat([part[name] for part in parts]) for name in tensors},
        )

    @property
    def nothing(self) -> bool:
        """Whether of nobody anything is open, or could be told, that is worth telling."""
        told = torch.cat([self.all_entropy.flatten(), self.information.flatten()])
        return bool((told < NEGLIGIBLE).all())

    def of(self, person: int, scenarios: Sequence[str]) -> dict[str, Any]:
        """What is open about one person, as ``summary.json`` has it."""
        entropy, shared = (part[person].tolist() for part in (self.entropy, self.shared))
        information, error = (
            part[person].tolist() for part in (self.information, self.information_error)
        )
        return {
            "open": dict(zip(self.sites, entropy, strict=True))
            | {"together": float(self.all_entropy[person])},
            "hangs_on_policy": dict(zip(self.sites, shared, strict=True))
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
    report: Report = silent,
    rounds: int = 8,
    first: int = 0,
) -> Identifiability | None:
    """What is open about people after a fit.

    Args:
        human: the model of people.
        train: the rounds that were learned from.
        draws: posterior draws ``[S, P, 1, ...]``, one after the other not alike.
        seed: of the rounds that are played.
        population: that people are from, if it was the prior.
        report: told of people done.
        rounds: that are played in each scenario; 0 for none.
        first: number of the first of these people among all.

    Returns:
        ``None`` of models in which there is nothing discrete to see, or in which actions depend on
        what is seen otherwise than through beliefs, or whose program is their own.
    """
    if has_own_program(human):
        return None
    sizes = {site: len(support) for site, support in perceived_sites(human).items()}
    if not sizes:
        return None
    held, people = next(iter(draws.values())).shape[:2]
    chosen = torch.linspace(0, held - 1, min(held, POLICIES)).round().long()
    found: list[tuple[Tensor, ...]] = []
    pooling = None if population is None else Pooling(human)
    for person in range(people):
        report("identify", person, people, "people")
        own = {name: value[:, person : person + 1] for name, value in draws.items()}
        drawn = combination_number({site: own[site][:, 0, 0] for site in sizes}, sizes)
        candidates, one = drawn.unique(), train.select_people([person])
        if len(candidates) <= FEW and ENOUGH * len(candidates) <= held:
            table = build_view_table(human, one, [candidates], likely=own, values=VALUES)
        else:  # draws are too few to tell how many there are
            table = build_view_table(human, one, screening=Screening(), likely=own, values=VALUES)
            candidates = table.possible[0].nonzero().squeeze(-1)
        if not acts_on_beliefs(human, table.sites):
            return None
        policy = {name: value[chosen] for name, value in own.items() if name not in sizes}
        joint = log_joints(human, table, policy, candidates)[:, 0]
        grid = {site: value[candidates] for site, value in combination_values(human, table).items()}
        if population is not None and pooling is not None:
            # On average: which population it is says nothing of how this person decides.
            chances = {
                site: value.mean(0, keepdim=True).expand(len(chosen), *value.shape[1:])
                for site, value in population.chances.items()
            }
            joint = joint + _instead_of_prior(grid, chances, pooling)
        weights = torch.log_softmax(joint, -1)  # [S, C]
        told = (weights.new_zeros(0),) * 2
        if rounds:
            # Of each person their own worlds, so that averages over people are of many.
            generator = torch.Generator(weights.device).manual_seed(
                seed * 1_000_003 + first + person
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
        found.append((*_open(weights, grid), *told))
    report("identify", people, people, "people")
    return Identifiability(tuple(sizes), *(torch.stack(part) for part in zip(*found, strict=True)))


def _instead_of_prior(
    grid: Mapping[str, Tensor], chances: Mapping[str, Tensor], pooling: Pooling
) -> Tensor:
    """Log ratio ``[S, C]`` of the prior of combinations in populations to the model's own.

    Sites that a population says nothing of keep their prior.
    """
    total = torch.zeros(())
    for site, support in pooling.supports.items():
        if site in grid:
            same = grid[site][:, None] == support
            ratio = (chances[site] / pooling.prior_chances[site]).log()
            # A value that the prior rules out has no chance.
            ratio = torch.where(same.any(-1), ratio[:, same.long().argmax(-1)], -torch.inf)
            total = total + ratio
    return total


def _open(weights: Tensor, grid: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Entropies and what is shared with policy, of each site ``[D]`` and of all together."""
    open_, shared = [], []
    for value in grid.values():
        values = value.unique()
        member = (value[:, None] == values).to(weights)
        pair = _entropy_and_shared(weights.exp() @ member)
        open_.append(pair[0])
        shared.append(pair[1])
    return torch.stack(open_), torch.stack(shared), *_entropy_and_shared(weights.exp())


def _entropy_and_shared(probability: Tensor) -> tuple[Tensor, Tensor]:
    """Of conditionals ``[S, n]``."""
    total = _entropy(probability.mean(0))
    return total, (total - _entropy(probability).mean()).clamp(min=0)


def _entropy(probability: Tensor) -> Tensor:
    return torch.special.entr(probability).sum(-1)


def _represented(weights: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Combinations that stand for all, and log weights ``[S, C']`` of them with each policy.

    All of them if they are few; else as many as are drawn, each with the weight of its draws. The
    weights of all pairs add up to 1.
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
    """Expected of a round in each scenario ``[N]``, in nats, and its standard error."""
    domain = human.domain
    number = len(domain.scenarios)
    # Who plays: every pair of policy and sight by its probability, the same in each scenario.
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
    with (
        poutine.block(),
        poutine.condition(data=dict(policy)),
        pyro.plate("draw", len(pairs), dim=-3),
        pyro.plate("person", 1, dim=-2),
    ):
        likelihood = log_likelihoods(human, human.prior(), table)
    likelihood = likelihood.expand(len(pairs), 1, -1)[:, 0]  # [S, U]
    joint = likelihood[:, table.index[0][:, candidates]] + pairs[:, None]  # [S, R, C]
    after = torch.softmax(torch.logsumexp(joint, 0), -1)  # [R, C]
    each = (_entropy(pairs.exp().sum(0)) - _entropy(after)).view(number, rounds)
    if rounds == 1:
        return each[:, 0], torch.full_like(each[:, 0], math.nan)
    return each.mean(-1), each.std(-1) / math.sqrt(rounds)

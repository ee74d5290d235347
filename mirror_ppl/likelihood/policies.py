"""Draws that stand for whoever a person may be, under which combinations are given up and merged.

Draws from the prior do, unless the program knows more of people than what it samples: a factor, an
observed site, a scale or a mask. Then draws are repeated as often as that makes them probable.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.combinations import discrete_sites, log_priors
from mirror_ppl.likelihood.densities import adds_to_prior, log_correction
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, draw_prior

ENOUGH = 32
"""So many draws from the prior have to be probable, or none of them is relied on."""
BATCHES = 16
AT_ONCE = 512
"""Draws from the prior that are looked at, AT_ONCE in each of BATCHES, until ENOUGH are."""
ENTRIES = 4_000_000
"""Of tables of priors; bounds memory."""


@torch.no_grad()
def draw_policies(
    human: HumanModel, grid: Mapping[str, Tensor], number: int, seed: int
) -> Draws | None:
    """So many policies ``[S, 1, 1, ...]``; always the same.

    Args:
        human: the model of people.
        grid: values ``[M]`` of the discrete sites that perception reads, for each combination.
        number: of policies S.
        seed: of their draws.

    Returns:
        The policies; ``None`` if hardly any draw from the prior is probable. With a site by which
        people are of different kinds, so many for each of its values in turn.

    Raises:
        HumanModelError: ``stratified_by`` is no discrete site.
    """
    found = _drawn_policies(human, grid, number, seed)
    site = human.stratified_by
    if found is None or site is None:
        return found
    discrete = discrete_sites(human)
    if site not in discrete:
        raise HumanModelError(
            f"{type(human).__name__}.stratified_by is {site!r}, no discrete site of prior()"
        )
    values = discrete[site].to(found[site])
    strata = {name: value.repeat_interleave(len(values), 0) for name, value in found.items()}
    strata[site] = values.repeat(number).view(-1, *[1] * (found[site].dim() - 1))
    return strata


def _drawn_policies(
    human: HumanModel, grid: Mapping[str, Tensor], number: int, seed: int
) -> Draws | None:
    if not adds_to_prior(human):
        return draw_prior(human, 1, number, seed)
    size = max(1, min(AT_ONCE, ENTRIES // max(len(one) for one in (*grid.values(), (0,)))))
    seeds = [seed * 1_000_003 + batch for batch in range(BATCHES)]
    found: list[Tensor] = []
    for own in seeds:
        found.append(_said(human, grid, draw_prior(human, 1, size, own)))
        if effective(torch.cat(found)) >= ENOUGH:
            break
    else:
        return None
    generator = torch.Generator().manual_seed(seed)
    weights = torch.softmax(torch.cat(found).double().cpu(), 0)
    chosen = torch.multinomial(weights, number, replacement=True, generator=generator)
    parts = []
    for draw in chosen.tolist():
        own = draw_prior(human, 1, size, seeds[draw // size])
        parts.append({name: value[draw % size, None] for name, value in own.items()})
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def effective(log_weights: Tensor) -> float:
    """Effective number of draws of log weights ``[S]``."""
    return float(1 / torch.softmax(log_weights.double(), 0).square().sum())


def within(human: HumanModel, log_joint: Tensor, margin: float) -> Tensor:
    """Which combinations ``[M]`` are worth keeping.

    Args:
        human: the model of people.
        log_joint: of each combination and what was recorded, under each policy ``[S, M]``.
        margin: nats by which one may fall behind the best, each under the policy that suits it
            best.
    """
    if dependencies(human).adds_to_actions:
        # What is recorded besides actions may tell of a person whom no policy resembles.
        log_joint = log_joint - log_joint.amax(-1, keepdim=True)
    best = log_joint.amax(0)
    return best >= best.max() - margin


def _said(human: HumanModel, grid: Mapping[str, Tensor], draws: Draws) -> Tensor:
    """By how much the program makes draws more probable than they are drawn, ``[S]``."""
    policy = {name: value for name, value in draws.items() if name not in grid}
    number = len(next(iter(draws.values()), (0,)))
    found = log_correction(human, grid, policy, 1)[:, 0].expand(number)
    if not grid:
        return found
    return found + log_priors(human, grid, policy, 1)[:, 0].logsumexp(-1)

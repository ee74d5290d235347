"""Representative draws of the policy implants, used to drop combinations and to merge moments.

They are draws from the prior. If the program has a factor, an observed site, a scale or a mask,
draws are resampled by the density that it adds.
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
"""Least effective number of prior draws; with fewer, none is used."""
BATCHES = 16
AT_ONCE = 512
"""Prior draws that are tried, AT_ONCE in each of BATCHES, until ENOUGH are effective."""
ENTRIES = 4_000_000
"""Largest size of tables of priors; bounds memory."""


@torch.no_grad()
def draw_policies(
    human: HumanModel, grid: Mapping[str, Tensor], number: int, seed: int, distinct: bool = False
) -> Draws | None:
    """Draw policies ``[S, 1, 1, ...]``; deterministic given the seed.

    Args:
        human: the model of people.
        grid: values ``[M, ...]`` of the sites that perception reads, for each combination.
        number: number of policies S.
        seed: seed of the draws.
        distinct: True for no draw twice, and for fewer policies if there are not as many draws.

    Returns:
        The policies; ``None`` if too few prior draws are effective. If ``stratified_by`` names a
        site, S for each of its values in turn.

    Raises:
        HumanModelError: ``stratified_by`` is no discrete site.
    """
    found = _drawn_policies(human, grid, number, seed, distinct)
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
    human: HumanModel, grid: Mapping[str, Tensor], number: int, seed: int, distinct: bool
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
    if distinct:
        number = min(number, int((weights > 0).sum()))
    chosen = torch.multinomial(weights, number, replacement=not distinct, generator=generator)
    parts = []
    for batch in (chosen // size).unique().tolist():
        own = draw_prior(human, 1, size, seeds[batch])
        rows = chosen[chosen // size == batch] % size
        parts.append({name: value[rows.to(value.device)] for name, value in own.items()})
    # In random order, as fewer of them distinguish moments.
    order = torch.randperm(number, generator=generator)
    return {name: torch.cat([part[name] for part in parts])[order] for name in parts[0]}


def effective(log_weights: Tensor) -> float:
    """Effective sample size of log weights ``[S]``."""
    return float(1 / torch.softmax(log_weights.double(), 0).square().sum())


def within(human: HumanModel, log_joint: Tensor, margin: float) -> Tensor:
    """Mask ``[M]`` of the combinations to keep.

    Args:
        human: the model of people.
        log_joint: log joint of each combination and the recordings, under each policy ``[S, M]``.
        margin: nats by which a combination may fall behind the best, each under its best policy.
    """
    if dependencies(human).adds_to_actions:
        # Recordings besides actions may be of a person whom no policy resembles.
        log_joint = (log_joint - log_joint.amax(-1, keepdim=True)).nan_to_num(-torch.inf)
    best = log_joint.amax(0)
    return best >= best.max() - margin


def _said(human: HumanModel, grid: Mapping[str, Tensor], draws: Draws) -> Tensor:
    """Log ratio ``[S]`` of the program's density of draws and the density of sampling them."""
    policy = {name: value for name, value in draws.items() if name not in grid}
    number = len(next(iter(draws.values()), (0,)))
    found = log_correction(human, grid, policy, 1)[:, 0].expand(number)
    if not grid:
        return found
    return found + log_priors(human, grid, policy, 1)[:, 0].logsumexp(-1)

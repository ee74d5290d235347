"""Combinations of the discrete implants that perception reads, and their prior."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import prod
from typing import Any
from weakref import WeakKeyDictionary

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.errors import HumanModelError, InputError
from mirror_ppl.likelihood.attention import attention_sites
from mirror_ppl.likelihood.densities import (
    BATCH,
    check_plates,
    correction,
    is_observed,
    log_prob,
    prior_nodes,
)
from mirror_ppl.models.dependencies import Sites, dependencies
from mirror_ppl.models.dependencies import forget as forget_dependencies
from mirror_ppl.models.handlers import BELIEVING, WithoutSites
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.sites import Readable, discrete_names, latent_sites
from mirror_ppl.randomness import forked
from mirror_ppl.user_code import is_of_package

MAX_COMBINATIONS = 100_000


def discrete_sites(human: HumanModel) -> dict[str, Tensor]:
    """Supports ``[n]`` of the discrete sites of a human model's prior, by name."""
    with forked(), pyro.plate("person", 1, dim=-2):
        trace = poutine.trace(human.prior).get_trace()
    sites = latent_sites(trace)
    return {
        name: sites[name]["fn"].enumerate_support(expand=False).flatten()
        for name in sites
        if name in discrete_names(trace)
    }


def require_own_attention(human: HumanModel, sites: Iterable[str]) -> None:
    """Refuse models whose round latents depend on perceptual implants.

    Args:
        human: the model of people.
        sites: names of the discrete sites that ``perceive`` reads.

    Raises:
        HumanModelError: a round latent depends on one of the sites.
    """
    for name, parents in dependencies(human).round_latents.items():
        if parents & set(sites):
            raise HumanModelError(
                f'"{name}" of round_latents depends on a discrete site that perceive() reads; let '
                "it depend on others only"
            )


def perceived_sites(human: HumanModel) -> dict[str, Tensor]:
    """Supports ``[n]`` of the discrete sites that ``perceive`` reads, in the program's order.

    Raises:
        HumanModelError: ``perceive`` reads a site that cannot be enumerated, one whose values are
            not 0, 1 and so on, or there are too many combinations of values.
    """
    supports = discrete_sites(human)
    others = unread_sites(human, supports)
    supports = {name: support for name, support in supports.items() if name not in others}
    for name, support in supports.items():
        if not torch.equal(support.long(), torch.arange(len(support), device=support.device)):
            raise HumanModelError(
                f'perceive() reads "{name}", whose values are not 0, 1 and so on; sample a place '
                "in a list of its values"
            )
    number = prod(len(support) for support in supports.values())
    if number > MAX_COMBINATIONS:
        raise HumanModelError(
            f"perceive() depends on {number} combinations of discrete values; "
            f"at most {MAX_COMBINATIONS} can be marginalized"
        )
    return supports


_unread: WeakKeyDictionary[HumanModel, tuple[Sites, Sites]] = WeakKeyDictionary()


def forget(human: HumanModel) -> None:
    """Drop what was found out about a human model, which may have been changed since."""
    _unread.pop(human, None)
    forget_dependencies(human)
    vars(human).pop("has_round_latents", None)


def unread_sites(human: HumanModel, supports: Mapping[str, Tensor] | None = None) -> Sites:
    """Discrete sites of the prior that ``perceive`` does not read in some trial rounds.

    Args:
        human: the model of people.
        supports: supports of all discrete sites; by default those of the last call.

    Raises:
        HumanModelError: ``perceive`` reads a site that cannot be enumerated.
    """
    known = _unread.get(human)
    if known is None or (supports is not None and known[0] != frozenset(supports)):
        supports = discrete_sites(human) if supports is None else supports
        names = frozenset(supports)
        known = _unread[human] = names, names - _read(human, supports)
    return known[1]


def _read(human: HumanModel, supports: Mapping[str, Tensor]) -> set[str]:
    """Sites that ``perceive`` reads in a round without messages or with all messages."""
    domain, device = human.domain, next(human.parameters()).device
    sites = {**supports, **attention_sites(human)}
    implants = Readable({name: support[:1] for name, support in sites.items()})
    state = domain.initial(1, torch.Generator(device).manual_seed(0))
    without: Any = human.nothing_known(1, device=device)
    informed: Any = without
    with WithoutSites(BELIEVING):
        for step in range(domain.horizon):
            now = domain.observe(state)
            told = domain.communicable(now)
            silence = {name: torch.zeros_like(mask) for name, mask in told.items()}
            _, without = human.perceive(implants, without, now, silence, step)
            _, informed = human.perceive(implants, informed, now, told, step)
            if implants.read >= sites.keys() and is_of_package(human):
                break  # there is no other; a user's model may read what cannot be enumerated
            action = torch.full((1,), step % len(domain.actions), device=device)
            state = domain.transition(state, action)
    return implants.read


def require_unread(human: HumanModel, names: Iterable[str]) -> None:
    """Refuse sites that ``perceive`` reads.

    Raises:
        InputError: ``perceive`` reads one of these.
    """
    read = perceived_sites(human)
    for name in names:
        if name in read:
            raise InputError(
                f'"{name}" was measured, but perceive() reads it, which is summed out: let a site '
                "of prior depend on it, and measure that one"
            )


def grid_of(supports: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Values ``[M]`` of sites for each of their M combinations, row-major."""
    if not supports:
        return {}
    # A grid of indices, since supports may have different dtypes.
    places = [torch.arange(len(support), device=support.device) for support in supports.values()]
    axes = torch.meshgrid(*places, indexing="ij")
    return {
        site: support[axis.flatten()]
        for (site, support), axis in zip(supports.items(), axes, strict=True)
    }


@torch.no_grad()
def log_priors(
    human: HumanModel, grid: Mapping[str, Tensor], draws: Mapping[str, Tensor], people: int
) -> Tensor:
    """Log prior probability ``[S, P, M]`` of each combination.

    Includes factors, observed sites, scales and masks of ``prior`` that depend on these sites; the
    rest is :func:`mirror_ppl.likelihood.densities.log_correction`.

    Args:
        human: the model of people.
        grid: values ``[M]`` of the discrete sites.
        draws: values of all other sites ``[S, P, 1, ...]``, on which the prior may depend.
        people: number of people P.

    Raises:
        HumanModelError: the prior of another site depends on these.
    """
    values = {site: value[:, None, None, None] for site, value in grid.items()}
    number = len(next(iter(draws.values()))) if draws else 1
    nodes = prior_nodes(human, {**draws, **values}, number, people)
    total = next(human.parameters()).new_zeros(1, 1, 1, 1)
    for name, node in nodes.items():
        if name in grid:
            own = _log_prior(node, grid[name])
        elif not is_observed(node) and len(node["fn"].batch_shape) > BATCH:
            raise HumanModelError(
                f'the prior of "{name}" depends on a discrete site that perceive() reads; let that '
                f'site depend on "{name}" instead, or override model(), if only to call '
                "super().model(rounds, world), for the engines svi and nuts"
            )
        else:  # scales and masks may depend on these sites where the density does not
            own = correction(node)
            if own is None or own.dim() <= BATCH:  # as in log_correction, which counts it
                continue
        check_plates(name, own, people)
        total = total + own
    size = max([len(value) for value in grid.values()], default=1)
    return total.expand(size, number, people, 1).squeeze(-1).permute(1, 2, 0)


def _log_prior(node: Any, value: Tensor) -> Tensor:
    """Log-probability ``[M, S, P, 1]`` of values ``[M]``; S may be 1 if draws do not differ."""
    fn = node["fn"]
    plain = node["mask"] is None and isinstance(node["scale"], (int, float))
    if len(fn.batch_shape) > BATCH or not plain:  # may depend on other discrete sites
        return log_prob(node)
    # The prior of most sites depends on no other site, so that it is one table.
    values, index = value.unique(return_inverse=True)
    table = fn.log_prob(values[:, None, None, None])
    if (table == table[:, :1]).all():
        table = table[:, :1]
    return node["scale"] * table[index]

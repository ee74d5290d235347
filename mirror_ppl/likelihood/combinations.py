"""The sites that perception reads, and the prior of their joint values."""

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
from mirror_ppl.likelihood.grid import Grid
from mirror_ppl.models.dependencies import Sites, dependencies
from mirror_ppl.models.dependencies import forget as forget_dependencies
from mirror_ppl.models.handlers import BELIEVING, WithoutSites
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.sites import Readable, discrete_names, latent_sites
from mirror_ppl.randomness import forked
from mirror_ppl.user_code import is_of_package

MAX_COMBINATIONS = 100_000
"""Largest number of combinations that are all summed over."""


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
        sites: names of the sites that ``perceive`` reads.

    Raises:
        HumanModelError: a round latent depends on one of the sites.
    """
    for name, parents in dependencies(human).round_latents.items():
        if parents & set(sites):
            raise HumanModelError(
                f'"{name}" of round_latents depends on a site that perceive() reads; let it depend '
                "on others only"
            )


def perceived_sites(human: HumanModel) -> dict[str, Tensor]:
    """Supports ``[n]`` of the discrete sites that ``perceive`` reads, in the program's order.

    Raises:
        HumanModelError: ``perceive`` reads a site whose values are not 0, 1 and so on, or only
            discrete sites with too many combinations.
    """
    read = perceived_names(human)
    supports = {name: own for name, own in discrete_sites(human).items() if name in read}
    for name, support in supports.items():
        if not torch.equal(support.long(), torch.arange(len(support), device=support.device)):
            raise HumanModelError(
                f'perceive() reads "{name}", whose values are not 0, 1 and so on; sample a place '
                "in a list of its values"
            )
    number = prod(len(support) for support in supports.values())
    if number > MAX_COMBINATIONS and not needs_points(human):
        raise HumanModelError(
            f"perceive() depends on {number} combinations of discrete values; at most "
            f"{MAX_COMBINATIONS} can be summed over"
        )
    return supports


def continuous_perceived(human: HumanModel) -> list[str]:
    """Names of the continuous sites that ``perceive`` reads, in the program's order."""
    discrete = discrete_sites(human)
    return [name for name in perceived_names(human) if name not in discrete]


def needs_points(human: HumanModel) -> bool:
    """True if ``perceive`` reads a continuous site, so that sums over values are estimated."""
    return bool(continuous_perceived(human))


def why_points(human: HumanModel) -> str:
    """Why a model needs points, for messages."""
    return f"perceive() reads the continuous {', '.join(continuous_perceived(human))}"


_read_by: WeakKeyDictionary[HumanModel, tuple[tuple[str, ...], Sites]] = WeakKeyDictionary()


def forget(human: HumanModel) -> None:
    """Drop what was found out about a human model, which may have been changed since."""
    _read_by.pop(human, None)
    forget_dependencies(human)
    vars(human).pop("has_round_latents", None)


def perceived_names(human: HumanModel) -> tuple[str, ...]:
    """Names of the sites of the prior that ``perceive`` reads, in the program's order."""
    return _trial(human)[0]


def unread_sites(human: HumanModel) -> Sites:
    """Sites of the prior that ``perceive`` does not read in some trial rounds."""
    known = _read_by.get(human)
    return _trial(human)[1] if known is None else known[1]


def copied_sites(human: HumanModel) -> list[str]:
    """Sites that ``perceive`` reads if it goes through all implants, as to copy them.

    The discrete sites, and continuous ones on which nothing else depends: others can be read by
    name, but who copies implants hardly means them.
    """
    found = dependencies(human)
    used = found.actions.union(*found.prior.values(), *found.round_latents.values())
    discrete = discrete_sites(human)
    names = draw_prior(human, 1, 1, 0)
    return [name for name in names if name in discrete or name not in used]


def _trial(human: HumanModel) -> tuple[tuple[str, ...], Sites]:
    """Sites that perception reads, and others; found once for each set of sites."""
    values = {name: value[0, 0] for name, value in draw_prior(human, 1, 1, 0).items()}
    known = _read_by.get(human)
    if known is None or {*known[0], *known[1]} != values.keys():
        read = _read(human, values)
        names = tuple(name for name in values if name in read)
        known = _read_by[human] = names, frozenset(values) - read
    return known


def _read(human: HumanModel, values: Mapping[str, Tensor]) -> set[str]:
    """Sites that ``perceive`` reads in a round without messages or with all messages.

    Args:
        human: the model of people.
        values: of the sites of its prior, ``[1, ...]``.
    """
    domain, device = human.domain, next(human.parameters()).device
    attention = {name: support[:1] for name, support in attention_sites(human).items()}
    implants = Readable({**values, **attention}, copied=(*copied_sites(human), *attention))
    enumerated = {*discrete_sites(human), *attention}
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
            if implants.read >= enumerated and is_of_package(human):
                break  # the package's models read the same sites at every step
            action = torch.full((1,), step % len(domain.actions), device=device)
            state = domain.transition(state, action)
    return implants.read


def require_unread(human: HumanModel, names: Iterable[str]) -> None:
    """Refuse sites that ``perceive`` reads.

    Raises:
        InputError: ``perceive`` reads one of these.
    """
    read = perceived_names(human)
    for name in names:
        if name in read:
            raise InputError(
                f'"{name}" was measured, but perceive() reads it, which is summed out: let a site '
                "of prior depend on it, and measure that one"
            )


@torch.no_grad()
def log_priors(
    human: HumanModel, grid: Mapping[str, Tensor], draws: Mapping[str, Tensor], people: int
) -> Tensor:
    """Log prior probability ``[S, P, M]`` of each combination; of points, less their log proposal.

    Includes factors, observed sites, scales and masks of ``prior`` that depend on these sites; the
    rest is :func:`mirror_ppl.likelihood.densities.log_correction`.

    Args:
        human: the model of people.
        grid: values ``[M, ...]`` of the sites that perception reads.
        draws: values of all other sites ``[S, P, 1, ...]``, on which the prior may depend.
        people: number of people P.

    Raises:
        HumanModelError: the prior of another site depends on these.
    """
    number = _number(draws)
    total = next(human.parameters()).new_zeros(1, 1, 1, 1)
    for name, node in _nodes(human, grid, draws, people).items():
        if name in grid:
            own = _log_prior(node, grid[name])
        elif not is_observed(node) and len(node["fn"].batch_shape) > BATCH:
            raise HumanModelError(
                f'the prior of "{name}" depends on a site that perceive() reads; let that site '
                f'depend on "{name}" instead, or, if it is known and the same for all people, '
                "observe it by obs=; if it is discrete, you may also override model(), if only to "
                "call super().model(rounds, world), for the engines svi and nuts"
            )
        else:  # scales and masks may depend on these sites where the density does not
            own = correction(node)
            if own is None or own.dim() <= BATCH:  # as in log_correction, which counts it
                continue
        check_plates(name, own, people)
        total = total + own
    size = max([len(value) for value in grid.values()], default=1)
    found = total.expand(size, number, people, 1).squeeze(-1).permute(1, 2, 0)
    if isinstance(grid, Grid) and grid.log_proposal is not None:
        return found - grid.log_proposal
    return found


@torch.no_grad()
def log_sampled(
    human: HumanModel, points: Mapping[str, Tensor], draws: Mapping[str, Tensor]
) -> Tensor:
    """Log density ``[S, M]`` with which ``prior`` samples values ``[M, ...]`` of some sites.

    Args:
        human: the model of people.
        points: the values.
        draws: values of all other sites ``[S, 1, 1, ...]``.
    """
    nodes = _nodes(human, points, draws, 1)
    each = [nodes[name]["fn"].log_prob(nodes[name]["value"]) for name in points]
    size = len(next(iter(points.values())))
    return torch.stack([own.expand(size, _number(draws), 1, 1) for own in each]).sum(0)[..., 0, 0].T


def _number(draws: Mapping[str, Tensor]) -> int:
    """Number of draws ``[S, ...]``; 1 if there are none."""
    return len(next(iter(draws.values()))) if draws else 1


def _nodes(
    human: HumanModel, grid: Mapping[str, Tensor], draws: Mapping[str, Tensor], people: int
) -> dict[str, Any]:
    """Trace nodes of ``prior`` for all values ``[M, ...]`` of some sites and draws of others."""
    values = {site: value[:, None, None, None] for site, value in grid.items()}
    return prior_nodes(human, {**draws, **values}, _number(draws), people)


def _log_prior(node: Any, value: Tensor) -> Tensor:
    """Log-probability ``[M, S, P, 1]`` of values ``[M]``; S may be 1 if draws do not differ."""
    fn = node["fn"]
    plain = node["mask"] is None and isinstance(node["scale"], (int, float))
    if value.is_floating_point() or len(fn.batch_shape) > BATCH or not plain:
        return log_prob(node)  # may depend on other sites, or has hardly a value twice
    # The prior of most sites depends on no other site, so that it is one table.
    values, index = value.unique(return_inverse=True)
    table = fn.log_prob(values[:, None, None, None])
    if (table == table[:, :1]).all():
        table = table[:, :1]
    return node["scale"] * table[index]

"""Sites and draws of the prior of a human model, without recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from typing import Any

import pyro
import torch
from pyro import poutine
from torch import Tensor
from torch.distributions import biject_to
from torch.distributions.constraints import Constraint

from mirror_ppl.checks import as_tensor, require_kind, seed_number, whole_number
from mirror_ppl.errors import HumanModelError, InputError, shown
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import RESIDUAL
from mirror_ppl.models.sites import latent_sites
from mirror_ppl.randomness import forked, person_seed, seed_everything

Draws = dict[str, Tensor]
"""Posterior or prior draws by site, ``[S, P, 1, ...]``: people at -2 of the batch dimensions."""


@torch.no_grad()
def sample_sites(
    human: HumanModel,
    people: int,
    draws: int | None = None,
    given: Mapping[str, Tensor] | None = None,
    handler: AbstractContextManager[Any] | None = None,
) -> dict[str, Any]:
    """Return the nodes of all sites of ``prior``, in the order of the program.

    Args:
        human: the model of people.
        people: number of people P.
        draws: number of draws S; if None, values have no such dimension.
        given: values ``[S, P, 1, ...]`` of sites that are not sampled.
        handler: an effect handler of Pyro's under which the program runs.
    """
    given = given or {}
    with ExitStack() as stack:
        stack.enter_context(poutine.block())
        trace = stack.enter_context(poutine.trace())
        stack.enter_context(poutine.condition(data=dict(given)))
        if handler is not None:
            stack.enter_context(handler)
        if draws is not None:
            stack.enter_context(pyro.plate("draw", draws, dim=-3))
        stack.enter_context(pyro.plate("person", people, dim=-2))
        human.prior()
    nodes = trace.trace.nodes
    latent = latent_sites(trace.trace)
    return {name: nodes[name] for name in nodes if name in latent or name in given}


def values_of(nodes: Mapping[str, Any]) -> Draws:
    """Return the values of sites, expanded to their full batch and event shapes."""
    return {
        name: node["value"].expand(node["fn"].batch_shape + node["fn"].event_shape)
        for name, node in nodes.items()
    }


def draw_prior(human: HumanModel, people: int, number: int, seed: int) -> Draws:
    """Draw ``[S, P, 1, ...]`` from the prior of all sites, in the order of the program.

    Args:
        human: the model of people.
        people: number of people P.
        number: number of draws S per person.
        seed: of everything random.

    Raises:
        InputError: an argument is of another kind, or there is no person or no draw.
    """
    require_kind(human, HumanModel, "human")
    people, number = whole_number(people, "people", 1), whole_number(number, "number", 1)
    seed = seed_number(seed)
    with forked():
        seed_everything(seed)
        return values_of(sample_sites(human, people, number))


def draw_prior_of_each(human: HumanModel, people: Sequence[str], number: int, seed: int) -> Draws:
    """Draw ``[S, P, 1, ...]`` like `draw_prior`, with a seed per person.

    Args:
        human: the model of people.
        people: ids of the P people.
        number: number of draws S per person.
        seed: of everything random.
    """
    each = []
    with forked():
        for person in people:
            seed_everything(person_seed(seed, person))
            each.append(values_of(sample_sites(human, 1, number)))
    return {name: torch.cat([own[name] for own in each], 1) for name in each[0]}


@torch.no_grad()
def checked_draws(human: HumanModel, draws: Any, people: int) -> Draws:
    """Check draws against the sites of a human model and move them to its device.

    Args:
        human: the model of people.
        draws: tensors, numpy arrays or lists ``[S, P, 1, ...]`` by site.
        people: expected number of people P.

    Raises:
        InputError: they are no such arrays, of another number of people, or have values outside
            the support of the sites.
        HumanModelError: there are no draws, or their sites are not the model's.
    """
    if not isinstance(draws, Mapping):
        raise InputError(f"draws must be a dict of arrays by site, not {shown(draws)}")
    with forked():
        sites = sample_sites(human, people)
    if missing := [name for name in sites if name not in draws]:
        raise HumanModelError(f"there are no draws of the site {', '.join(missing)}")
    if more := [shown(name) for name in draws if name not in sites]:
        raise HumanModelError(
            f"there are draws of {', '.join(more)}, expected those of the sites {', '.join(sites)}"
        )
    given = {name: as_tensor(draws[name], f'"{name}"') for name in sites}
    number = next((len(value) for value in given.values() if value.dim()), 0)
    own = {}
    for name, value in given.items():
        example = sites[name]["value"]
        expected = (number, people, 1, *sites[name]["fn"].event_shape)
        if value.dim() > 1 and value.shape[1] != people:
            raise InputError(f'draws of "{name}" are of {value.shape[1]} people, expected {people}')
        if tuple(value.shape) != expected:
            raise InputError(
                f'draws of "{name}" have shape {tuple(value.shape)}, expected {expected}: draws, '
                "people, 1, and those of the site"
            )
        own[name] = value.to(example.device, example.dtype)
        changed = own[name] != value.to(example.device)
        if not example.is_floating_point() and changed.any():
            raise InputError(
                f'draws of "{name}" have {value[changed.to(value.device)][0]:g}, expected whole '
                "numbers"
            )
    if number == 0:
        return own
    # Run under these draws, because the support of a site may depend on other sites.
    nodes = sample_sites(human, people, number, own)
    for name, value in own.items():
        possible = _possible(nodes[name]["fn"].support, value)
        infinite = ~value.isfinite()
        if infinite.any() or not possible.all():
            bad = infinite if infinite.any() else ~possible
            raise InputError(
                f'draws of "{name}" have {value[bad].flatten()[0]:g}, expected only what the human '
                "model can sample"
            )
    return own


def _possible(support: Constraint, value: Tensor) -> Tensor:
    """True where values are in the support or at its boundary, such as a consistency of 0."""
    possible = support.check(value)
    if value.is_floating_point():
        for limit in (torch.inf, -torch.inf):
            possible = possible | support.check(value.nextafter(torch.full_like(value, limit)))
    return possible


def scalar_sites(human: HumanModel) -> dict[str, Any]:
    """Return the continuous scalar sites, each with its transform from unconstrained space."""
    with forked():
        return {
            name: biject_to(node["fn"].support)
            for name, node in sample_sites(human, 1).items()
            if not node["fn"].has_enumerate_support and node["fn"].event_dim == 0
        }


def sites_of_several_numbers(human: HumanModel) -> dict[str, list[int]]:
    """Return the shapes of sites of several numbers, but for the weights of the residual."""
    with forked():
        return {
            name: list(node["fn"].event_shape)
            for name, node in sample_sites(human, 1).items()
            if node["fn"].event_dim and name not in RESIDUAL
        }


def unconstrained(
    sites: Mapping[str, Any], policy: Mapping[str, Tensor], number: int = 0
) -> Tensor:
    """Map scalar sites of draws to unconstrained space, ``[S, D]``; ``number`` is S if D is 0."""
    if not sites:
        return torch.zeros(number, 0)
    return torch.stack([site.inv(policy[name].flatten()) for name, site in sites.items()], -1)

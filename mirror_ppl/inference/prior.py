"""The prior of a human model: its sites, and draws of them without any recordings."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from typing import Any

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.sites import latent_sites

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
    """Nodes of all sites of ``prior`` and ``act``, in the order of the program.

    Args:
        human: the model of people.
        people: number of people P.
        draws: number of draws S of each; without, values have no such dimension.
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
        implants = human.prior()
        # One made-up belief is enough for the sites that act() may add.
        belief = next(human.parameters()).new_zeros(people, 1, 1, human.belief_size)
        human.act(implants, belief, human.action_values(belief))
    nodes = trace.trace.nodes
    latent = latent_sites(trace.trace)
    return {name: nodes[name] for name in nodes if name in latent or name in given}


def values_of(nodes: Mapping[str, Any]) -> Draws:
    """Values of sites, with dimensions of size one where Pyro spares them."""
    return {
        name: node["value"].expand(node["fn"].batch_shape + node["fn"].event_shape)
        for name, node in nodes.items()
    }


def draw_prior(human: HumanModel, people: int, number: int, seed: int) -> Draws:
    """Draws ``[S, P, 1, ...]`` of the prior of all sites, in the order of the program."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return values_of(sample_sites(human, people, number))

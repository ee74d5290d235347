"""What depends on what in a human program, read from one run of it.

Sampled values are followed through the run by Pyro's provenance tensors, as in
:func:`pyro.infer.inspect.get_dependencies`: a site depends on those of whose values its log density
is computed. This errs on the safe side. Zero times a value counts as a dependence; a shape, a dtype
or a device that is taken from a value (``new_full``, ``expand_as``, ``to``) does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import pyro
import torch
from pyro import poutine
from pyro.ops.provenance import detach_provenance, get_provenance, track_provenance
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor
from torch.overrides import TorchFunctionMode

from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.sites import latent_sites, sample_nodes

Sites = frozenset[str]

FROM_SHAPE_OF_FIRST = {
    *(getattr(Tensor, f"new_{kind}") for kind in ("empty", "full", "ones", "tensor", "zeros")),
    *(getattr(torch, f"{kind}_like") for kind in ("empty", "full", "ones", "rand", "zeros")),
}
"""Functions whose result takes only shape, dtype and device from their first argument,"""
FROM_SHAPE_OF_OTHERS = {
    *(getattr(Tensor, f"{kind}_as") for kind in ("expand", "reshape", "type", "view")),
    Tensor.to,
}
"""and those whose result takes only these from all others."""


@dataclass(frozen=True)
class Dependencies:
    """Of a human program: the sites on whose values something depends directly.

    Attributes:
        prior: of each site of ``prior``, observed sites and factors among them, other sites of it.
        round_latents: of each site of ``round_latents``, sites of ``prior`` and others of it.
        actions: of the action of a step, and of what else ``act`` observes or adds, given beliefs.
    """

    prior: Mapping[str, Sites]
    round_latents: Mapping[str, Sites]
    actions: Sites


_found: WeakKeyDictionary[HumanModel, Dependencies] = WeakKeyDictionary()


def dependencies(human: HumanModel) -> Dependencies:
    """The dependencies of a human model's program; it runs once, for one person and round."""
    if human not in _found:
        _found[human] = _run(human)
    return _found[human]


@torch.no_grad()
def _run(human: HumanModel) -> Dependencies:
    like = next(human.parameters())
    belief = like.new_zeros(1, 1, human.belief_size)
    values, action = human.action_values(belief), torch.zeros(1, 1, dtype=torch.long)
    with (
        torch.random.fork_rng(devices=[]),
        pyro.validation_enabled(False),
        poutine.block(),
        _Followed(),
        _ValuesAlone(),
        pyro.plate("person", 1, dim=-2),
    ):
        torch.manual_seed(0)
        with poutine.trace() as prior:
            implants = human.prior()
        with pyro.plate("round", 1, dim=-1):
            with poutine.trace() as latents:
                human.round_latents(implants)
            with poutine.trace() as act:
                human.choose(implants, belief, values, action.to(like.device))
        return Dependencies(
            _parents(prior.trace),
            _parents(latents.trace),
            frozenset().union(*_parents(act.trace).values()),
        )


def _parents(trace: poutine.Trace) -> dict[str, Sites]:
    """The sites on which the density of each node depends, but for its own value if sampled."""
    latent, found = latent_sites(trace), {}
    for name, node in sample_nodes(trace).items():
        value = detach_provenance(node["value"]) if name in latent else node["value"]
        density = node["fn"].log_prob(value, *node["args"], **node["kwargs"])
        found[name] = get_provenance([density, node["scale"], node["mask"]])
    return found


class _Followed(Messenger):
    """Values of latent sites carry the name of their site wherever they go."""

    def _pyro_post_sample(self, msg: Any) -> None:
        if not (msg["is_observed"] or site_is_subsample(msg)):
            value = detach_provenance(msg["value"])
            msg["value"] = track_provenance(value, frozenset({msg["name"]}))


class _ValuesAlone(TorchFunctionMode):
    """What takes only its shape or kind from a value does not depend on it."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func in FROM_SHAPE_OF_FIRST:
            args = (detach_provenance(args[0]), *args[1:])
        elif func in FROM_SHAPE_OF_OTHERS:
            args = (args[0], *map(detach_provenance, args[1:]))
        return func(*args, **(kwargs or {}))

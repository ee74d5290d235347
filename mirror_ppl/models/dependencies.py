"""Dependencies between the sites of a human program, found by running it.

Pyro's provenance tensors track sampled values through one run, as in
:func:`pyro.infer.inspect.get_dependencies`: a site depends on the sites whose values enter its log
density. Zero times a value counts as a dependence; a shape, a dtype or a device that is taken from
a value (``new_full``, ``expand_as``, ``to``) does not. Provenance is lost where a value is assigned
to part of a tensor or leaves torch, so densities are also compared under different values.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import pyro
import torch
from pyro import poutine
from pyro.distributions.util import scale_and_mask
from pyro.ops.provenance import detach_provenance, get_provenance, track_provenance
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor
from torch.overrides import TorchFunctionMode

from mirror_ppl.models.handlers import WithoutSites
from mirror_ppl.models.human import ACTION, HumanModel
from mirror_ppl.models.sites import latent_sites, latent_values, sample_nodes
from mirror_ppl.randomness import forked, seed_everything

Sites = frozenset[str]
TRIED = 32
"""Maximum number of values of a discrete site under which densities are compared."""

FROM_SHAPE_OF_FIRST = {
    *(getattr(Tensor, f"new_{kind}") for kind in ("empty", "full", "ones", "tensor", "zeros")),
    *(getattr(torch, f"{kind}_like") for kind in ("empty", "full", "ones", "rand", "zeros")),
}
"""Functions whose result takes only shape, dtype and device from their first argument."""
FROM_SHAPE_OF_OTHERS = {
    *(getattr(Tensor, f"{kind}_as") for kind in ("expand", "reshape", "type", "view")),
    Tensor.to,
}
"""Functions whose result takes only these from all other arguments."""


ADDS_TO_ROUNDS = "adds_to_rounds"
"""Attribute of posterior files for models with terms of rounds besides actions."""


@dataclass(frozen=True)
class Dependencies:
    """The direct dependencies in a human program.

    Attributes:
        prior: parents of each site of ``prior``, including its observed sites and factors.
        round_latents: parents of each site of ``round_latents``, from ``prior`` or itself.
        actions: parents, given beliefs, of a step's action and of other terms that ``act`` adds.
        latent: the sites of ``prior`` that are sampled.
        adds_to_actions: whether ``act`` adds terms besides the probabilities of actions: a factor,
            an observed site, a scale or a mask.
        adds_to_latents: whether ``round_latents`` adds terms besides its sampled sites.
    """

    prior: Mapping[str, Sites]
    round_latents: Mapping[str, Sites]
    actions: Sites
    latent: Sites
    adds_to_actions: bool
    adds_to_latents: bool

    @property
    def adds_to_rounds(self) -> bool:
        """True if the density of a round is not the probability of its actions alone."""
        return self.adds_to_actions or self.adds_to_latents


_found: WeakKeyDictionary[HumanModel, Dependencies] = WeakKeyDictionary()


def dependencies(human: HumanModel) -> Dependencies:
    """Return the dependencies of a human model's program; cached for each model."""
    if human not in _found:
        _found[human] = _run(human)
    return _found[human]


def forget(human: HumanModel) -> None:
    """Drop what was found; the human model may have been changed since."""
    _found.pop(human, None)


@torch.no_grad()
def _run(human: HumanModel) -> Dependencies:
    like = next(human.parameters())
    belief = like.new_zeros(1, 1, human.belief_size)
    with WithoutSites("action_values"):
        values = human.action_values(belief)
    action = torch.zeros(1, 1, dtype=torch.long)
    with (
        forked(),
        pyro.validation_enabled(False),
        poutine.block(),
        _Followed(),
        _ValuesAlone(),
        pyro.plate("person", 1, dim=-2),
    ):
        seed_everything(0)
        with poutine.trace() as prior:
            implants = human.prior()
        with pyro.plate("round", 1, dim=-1):
            with poutine.trace() as latents:
                human.round_latents(implants)
            with poutine.trace() as act:
                human.choose(implants, belief, values, action.to(like.device))
        found = _parents(prior.trace)
        actions = frozenset().union(*_parents(act.trace).values())
    sites = latent_sites(prior.trace)
    of_latents, hidden = _hidden_causes(human, sites, latent_values(latents.trace))
    return Dependencies(
        found | _hidden_parents(human, found),
        {name: parents | of_latents for name, parents in _parents(latents.trace).items()},
        actions | hidden,
        frozenset(sites),
        any(name != ACTION or _changed(node) for name, node in sample_nodes(act.trace).items()),
        any(node["is_observed"] or _changed(node) for node in sample_nodes(latents.trace).values()),
    )


def _changed(node: Mapping[str, Any]) -> bool:
    """True if a node has a scale or a mask."""
    plain = isinstance(node["scale"], (int, float)) and node["scale"] == 1
    return node["mask"] is not None or not plain


@contextmanager
def _as_drawn(seed: int, given: Mapping[str, Tensor]) -> Iterator[None]:
    """Run the program for one person, with draws that depend on the seed."""
    with (
        forked(),
        pyro.validation_enabled(False),
        poutine.block(),
        poutine.condition(data=dict(given)),
        pyro.plate("person", 1, dim=-2),
    ):
        seed_everything(seed)
        yield


def _hidden_parents(human: HumanModel, found: Mapping[str, Sites]) -> dict[str, Sites]:
    """Find parents of sites of ``prior`` that provenance loses, as by assignment to a slice.

    A density that differs between two draws of all other sites depends on some of them; all count
    as its parents.
    """
    nodes = []
    for seed in range(2):
        with _as_drawn(seed, {}), poutine.trace() as trace:
            human.prior()
        nodes.append(sample_nodes(trace.trace))
    latent, hidden = frozenset(latent_sites(trace.trace)), {}
    for name in found.keys() & nodes[0].keys() & nodes[1].keys():
        value = nodes[0][name]["value"]
        one, other = (_density(each[name], value) for each in nodes)
        if not found[name] and not torch.equal(one, other):
            hidden[name] = latent - {name}
    return hidden


def _hidden_causes(
    human: HumanModel, sites: Mapping[str, Any], latents: Mapping[str, Any]
) -> tuple[Sites, Sites]:
    """Find discrete sites of ``prior`` that change densities of ``round_latents`` or ``act``.

    Provenance may have lost them. Each site is tried at its values, with all others fixed.
    """
    like = next(human.parameters())
    with forked():
        seed_everything(0)
        belief = torch.randn(1, 1, human.belief_size).to(like)
    with WithoutSites("action_values"):
        values = human.action_values(belief)
    action = torch.zeros(1, 1, dtype=torch.long)
    same = {name: detach_provenance(value) for name, value in latents.items()}

    def said(given: Mapping[str, Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        with _as_drawn(0, {**given, **same}):
            implants = human.prior()
            with pyro.plate("round", 1, dim=-1):
                with poutine.trace() as attended:
                    human.round_latents(implants)
                with poutine.trace() as act:
                    human.choose(implants, belief, values, action.to(like.device))
        return _densities(attended.trace), _densities(act.trace)

    usual = {name: detach_provenance(node["value"]) for name, node in sites.items()}
    of_latents, of_actions = set(), set()
    for name, node in sites.items():
        if node["fn"].has_enumerate_support and not node["fn"].event_dim:
            support = node["fn"].enumerate_support(expand=False).flatten()
            tried = [said({**usual, name: value.view(1, 1)}) for value in _some(support)]
            for found, each in ((of_latents, 0), (of_actions, 1)):
                if any(not _equal(tried[0][each], one[each]) for one in tried):
                    found.add(name)
    return frozenset(of_latents), frozenset(of_actions)


def _some(support: Tensor) -> Tensor:
    """Return at most `TRIED` values of a support, evenly spaced."""
    number = min(len(support), TRIED)
    return support[torch.linspace(0, len(support) - 1, number).round().long()]


def _densities(trace: poutine.Trace) -> list[Tensor]:
    """Return the densities of all nodes, with their scales and masks."""
    return [_density(node, node["value"]) for node in sample_nodes(trace).values()]


def _density(node: Mapping[str, Any], value: Any) -> Tensor:
    found = scale_and_mask(node["fn"].log_prob(value), node["scale"], node["mask"])
    return torch.as_tensor(found)


def _equal(one: Sequence[Tensor], other: Sequence[Tensor]) -> bool:
    return len(one) == len(other) and all(map(torch.equal, one, other))


def _parents(trace: poutine.Trace) -> dict[str, Sites]:
    """Return the sites on which the density of each node depends, without its own sampled value."""
    latent, found = latent_sites(trace), {}
    for name, node in sample_nodes(trace).items():
        value = detach_provenance(node["value"]) if name in latent else node["value"]
        density = node["fn"].log_prob(value, *node["args"], **node["kwargs"])
        found[name] = get_provenance([density, node["scale"], node["mask"]])
    return found


class _Followed(Messenger):
    """Tags values of latent sites with the name of their site."""

    def _pyro_post_sample(self, msg: Any) -> None:
        if not (msg["is_observed"] or site_is_subsample(msg)):
            value = detach_provenance(msg["value"])
            msg["value"] = track_provenance(value, frozenset({msg["name"]}))


class _ValuesAlone(TorchFunctionMode):
    """Drops provenance where only the shape, dtype or device of a value is used."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func in FROM_SHAPE_OF_FIRST:
            args = (detach_provenance(args[0]), *args[1:])
        elif func in FROM_SHAPE_OF_OTHERS:
            args = (args[0], *map(detach_provenance, args[1:]))
        return func(*args, **(kwargs or {}))

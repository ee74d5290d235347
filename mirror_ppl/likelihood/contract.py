"""Check of the contract of human models, before long computations."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pyro
import torch
from pyro import poutine
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from mirror_ppl.checks import require_kind
from mirror_ppl.domains import Domain
from mirror_ppl.domains.record import require_power
from mirror_ppl.errors import HumanModelError, MirrorError, UnreadSite
from mirror_ppl.likelihood.agreement import check_agreement, unused_sites
from mirror_ppl.likelihood.combinations import copied_sites, forget, needs_points
from mirror_ppl.likelihood.points import PriorPoints
from mirror_ppl.likelihood.site_contract import (
    check_names,
    check_sight,
    check_sites,
    check_supports,
    refuse_parameters,
    refuse_plates,
)
from mirror_ppl.likelihood.span_contract import check_spans_hold
from mirror_ppl.models.handlers import BELIEVING, WithoutSites
from mirror_ppl.models.human import HumanModel, Implants, has_own_program, overrides
from mirror_ppl.models.sites import Readable, latent_sites, latent_values
from mirror_ppl.models.view import View
from mirror_ppl.randomness import forked, seed_everything
from mirror_ppl.shapes import broadcast_shapes
from mirror_ppl.user_code import describe, is_of_package


@torch.no_grad()
def check_contract(human: HumanModel, shipped: bool = False) -> None:
    """Run a human model on a made-up round, to find errors before long computations.

    Args:
        human: the model of people.
        shipped: True to check models of the package in worlds of the package, too. Its tests do so
            for each; fits skip them, as the check takes as long as inferring one or two people.

    Raises:
        HumanModelError: a method fails or returns the wrong thing; names the method and the line.
        InputError: its power of the likelihood is none.

    Warns:
        UnreadSite: nothing seems to depend on some sites of the prior.
    """
    require_kind(human, HumanModel, "human")
    domain = human.domain
    require_power(human.likelihood_power, f"{type(human).__name__}.likelihood_power")
    if not shipped and all(map(is_of_package, (human, human.self_model, domain))):
        return
    forget(human)
    like = next(human.parameters())
    if like.dtype != torch.float32:
        raise HumanModelError(f"parameters are of {like.dtype}, expected torch.float32")
    device = like.device
    generator = torch.Generator(device).manual_seed(0)
    people, steps, actions = 2, 3, len(domain.actions)
    state, observed = domain.initial(people, generator), []
    none, done = (torch.full((people,), action, device=device) for action in (actions, 0))
    for _ in range(steps):
        observed.append(domain.observe(state))
        state = domain.transition(state, done)
    told = {
        m.name: torch.zeros(people, len(m.items), dtype=torch.bool, device=device)
        for m in domain.modalities
    }
    copied = _copied(human)
    method = "prior"
    try:
        with (
            forked(),
            poutine.block(),
            poutine.trace() as trace,
            pyro.plate("person", people, dim=-2),
        ):
            seed_everything(0)
            implants = human.prior()
            if not isinstance(implants, Mapping):
                raise HumanModelError(
                    f"prior returned {type(implants).__name__}, expected a dict of sites by name"
                )
            _check_returned("prior", implants, latent_sites(trace.trace))
            check_sites(trace.trace, people)
            check_sight(domain, trace.trace)
            method = "round_latents"
            latents = _round_latents(human, _Returned(implants), people)
            for name in set(latents) & set(latent_sites(trace.trace)):
                raise HumanModelError(f'"{name}" is a site of prior() and of round_latents()')
            own = {name: value[:, 0] for name, value in latent_values(trace.trace).items()}
            sites = {
                name: value.expand(people, *value.shape[1:])
                for name, value in own.items()
                if name in implants
            }
            belief = next(human.parameters()).new_zeros(people, human.belief_size)
            method = "nothing_known"
            knowledge: Any = human.nothing_known(people, device=device)
            _check_knowledge("nothing_known returned {}", knowledge, (people,))
            for step, now in enumerate(observed):
                with WithoutSites(BELIEVING):
                    readable = Readable(sites | latents, implants.keys(), copied + [*latents])
                    if overrides(human, "sees"):
                        method = "sees"
                        _check_sees(domain, human.sees(readable, now, step), people)
                    method = "perceive"
                    view, knowledge = _perceived(
                        human.perceive(readable, knowledge, now, told, step)
                    )
                    _check_knowledge("perceive returned {} as knowledge", knowledge, (1, people))
                    method = "evidence"
                    evidence = human.evidence(view, now)
                    method = "believe"
                    belief = human.belief_after(
                        belief, evidence, none if step == 0 else done, view.still
                    )
                if tuple(belief.shape) != (people, human.belief_size):
                    raise HumanModelError(
                        f"believe returned shape {tuple(belief.shape)}, expected "
                        f"({people}, {human.belief_size}) for {people} beliefs"
                    )
                _check_dtype(human, "believe", belief)
                method = "act"
                _check_act(human, _Returned(implants), belief)
        refuse_parameters(trace.trace)
        check_names(domain, [*latent_sites(trace.trace), *latents])
        check_supports(human)
        if needs_points(human):
            PriorPoints.of(human)
        method = "spans"
        if human.chained:
            check_spans_hold(human, {name: value[:1] for name, value in sites.items()})
        unused: list[str] = []
        if not has_own_program(human):
            method = "model"
            check_agreement(human)
            unused = unused_sites(human)
    except MirrorError:
        raise
    except (Exception, SystemExit) as error:
        file = getattr(sys.modules.get(type(human).__module__), "__file__", None)
        where = describe(error, None if file is None else Path(file))
        if isinstance(error, NotReturned):
            where += "; prior() does not return that: start from super().prior(), and return"
            where += " what you add to it by its name"
            where += " (of covariates, use .get)" if method == "round_latents" else ""
        raise HumanModelError(f"{type(human).__name__}.{method} fails: {where}") from error
    if unused:
        names = ", ".join(f'"{name}"' for name in unused)
        warnings.warn(
            f"nothing in {type(human).__name__} was found to depend on {names}, so that the "
            "posterior is the prior: return each site from prior() by its name, and read it in "
            "perceive, sees or act, or leave it out",
            UnreadSite,
            stacklevel=4,  # of no_grad, too
        )


def _copied(human: HumanModel) -> list[str]:
    """Sites that a copy of all implants reads; none if the program fails, as is said later."""
    try:
        return copied_sites(human)
    except (Exception, SystemExit):
        return []


class NotReturned(KeyError):
    """Raised where a method reads something that ``prior`` did not return."""


class _Returned(dict[str, Tensor]):
    """What ``prior`` returned, for another method."""

    def __missing__(self, name: str) -> Tensor:
        raise NotReturned(name)


def _perceived(found: Any) -> tuple[View, Any]:
    """Return what ``perceive`` returned, checked to be a view and knowledge."""
    if isinstance(found, tuple) and len(found) == 2 and isinstance(found[0], View):  # noqa: PLR2004
        return found
    given = type(found).__name__
    if isinstance(found, tuple):
        given = f"({', '.join(type(part).__name__ for part in found)})"
    raise HumanModelError(
        f"perceive returned {given}, expected (View, knowledge): what is perceived "
        "(mirror_ppl.models.View), and the person's memory after this step"
    )


def _check_knowledge(what: str, knowledge: Any, numbers: tuple[int, ...]) -> None:
    """Check that knowledge is a dataclass, as its tensors are selected by people.

    Their first dimension is one of the ``numbers``, of which the last is that of people.
    """
    if not is_dataclass(knowledge):
        found = what.format(type(knowledge).__name__)
        raise HumanModelError(f"{found}, expected a dataclass of tensors")
    for field in fields(knowledge):
        part = getattr(knowledge, field.name)
        if is_dataclass(part):
            _check_knowledge(what, part, numbers)
        elif torch.is_tensor(part) and (part.dim() == 0 or len(part) not in numbers):
            found = what.format(f"{field.name} of shape {tuple(part.shape)}")
            raise HumanModelError(
                f"{found}, expected ({numbers[-1]}, ...) for {numbers[-1]} people"
            )


def _check_sees(domain: Domain, masks: Any, people: int) -> None:
    """Check the masks of items that people see ``[P, K]``, by modality."""
    names = [modality.name for modality in domain.modalities]
    if not isinstance(masks, Mapping) or set(masks) != set(names):
        given = ", ".join(map(str, masks)) if isinstance(masks, Mapping) else type(masks).__name__
        raise HumanModelError(
            f"sees returned {given or 'nothing'}, expected a dict with a mask of each modality: "
            f"{', '.join(names)}"
        )
    for modality in domain.modalities:
        mask, expected = masks[modality.name], (people, len(modality.items))
        if not torch.is_tensor(mask) or mask.dtype != torch.bool:
            own = mask.dtype if torch.is_tensor(mask) else type(mask).__name__
            raise HumanModelError(
                f'sees returned {own} for "{modality.name}", expected a tensor of torch.bool'
            )
        sizes = zip(reversed(mask.shape), reversed(expected), strict=False)
        if mask.dim() > len(expected) or any(own not in (1, size) for own, size in sizes):
            raise HumanModelError(
                f'sees returned shape {tuple(mask.shape)} for "{modality.name}", expected '
                f"{expected} for (people, items)"
            )


def _check_dtype(human: HumanModel, method: str, found: Tensor) -> None:
    expected = next(human.parameters()).dtype
    if found.dtype != expected:
        raise HumanModelError(
            f"{method} returned {found.dtype}, expected {expected}; numpy's numbers make tensors "
            "of 64 bits: convert them, or end with .float()"
        )


def _check_act(human: HumanModel, implants: Implants, belief: Tensor) -> None:
    """Check ``act`` at beliefs ``[P, Z]``, one round per person; runs inside the person plate."""
    belief = belief[:, None]
    with WithoutSites("action_values"):
        values = human.action_values(belief)
    with poutine.block(), poutine.trace() as trace, pyro.plate("round", 1, dim=-1):
        found = human.act(implants, belief, values)
    for name in latent_sites(trace.trace):
        raise HumanModelError(
            f'act samples "{name}" at every step; sample it in prior if it is one of a person, '
            "else sum it out in what act returns, by torch.logaddexp"
        )
    refuse_parameters(trace.trace)
    refuse_plates(trace.trace)
    expected = (len(belief), 1, len(human.domain.actions))
    if not torch.is_tensor(found):
        raise HumanModelError(f"act returned {type(found).__name__}, expected log-probabilities")
    if tuple(found.shape[-3:]) != expected:
        raise HumanModelError(
            f"act returned shape {tuple(found.shape)}, expected {expected} for (people, rounds, "
            "actions)"
        )
    _check_dtype(human, "act", found)
    if bool(found.isnan().any()):
        raise HumanModelError(f"{type(human).__name__}.act returns nan")
    total = found.exp().sum(-1)
    if not torch.allclose(total, torch.ones_like(total), atol=1e-3):
        raise HumanModelError("act has to return log-probabilities: they do not sum to 1")


def _round_latents(human: HumanModel, implants: Implants, people: int) -> dict[str, Tensor]:
    """Check ``round_latents``, and sample it in one round of each person, ``[people]``."""
    with poutine.block(), poutine.trace() as trace, pyro.plate("round", 1, dim=-1):
        returned = human.round_latents(implants)
    sites = latent_sites(trace.trace)
    if not isinstance(returned, Mapping) or set(returned) != set(sites):
        raise HumanModelError(
            "round_latents has to return a dict of the sites that it samples, by name"
        )
    _check_returned("round_latents", returned, sites)
    for name, site in trace.trace.nodes.items():
        if not sites and site["type"] == "sample" and not site_is_subsample(site):
            raise HumanModelError(
                f'round_latents has "{name}", but no site that differs from round to round: put it '
                "into prior"
            )
    refuse_parameters(trace.trace)
    refuse_plates(trace.trace)
    for name, site in sites.items():
        if not site["fn"].support.is_discrete:
            raise HumanModelError(f'"{name}" of round_latents is not discrete')
        shape, event = tuple(site["fn"].batch_shape), tuple(site["fn"].event_shape)
        if event or broadcast_shapes(shape, (people, 1)) != (people, 1):
            raise HumanModelError(
                f'"{name}" of round_latents has shape {shape} and event shape {event}, expected '
                f"({people}, 1) and () for {people} people with one round"
            )
        if not site["fn"].has_enumerate_support:
            raise HumanModelError(f'"{name}" of round_latents has no finite support')
    return {name: site["value"].flatten()[:people].expand(people) for name, site in sites.items()}


def _check_returned(method: str, returned: Mapping[str, Any], sites: Mapping[str, Any]) -> None:
    """Refuse returned values that differ from the sampled ones: engines read the sites."""
    for name in returned:
        if name in sites:
            own = torch.as_tensor(sites[name]["value"])
            value = torch.as_tensor(returned[name])
            if not torch.equal(*torch.broadcast_tensors(value, own)):
                raise HumanModelError(
                    f'{method} returns other values of "{name}" than those that it sampled; sample '
                    "what it returns, or let the method that reads it change it"
                )

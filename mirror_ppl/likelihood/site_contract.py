"""Check of the sample sites of human models: names, distributions, plates and shapes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pyro.distributions as dist
import torch
from pyro import poutine
from pyro.distributions.torch_distribution import MaskedDistribution
from torch.distributions import Independent, biject_to

from mirror_ppl.domains import Domain
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.densities import PLATES, check_plates, log_prob, sample_nodes
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import SIGHT
from mirror_ppl.models.prior import sample_sites
from mirror_ppl.models.sites import latent_sites
from mirror_ppl.randomness import forked, seed_everything

AXES = (
    *("chain", "draw", "person", "round", "test_round", "step", "time", "direction", "sample"),
    *("action", "action_name", "action_probability", "action_entropy", "observed_action", "ego"),
    *("ego_feature", "site", "scenario", "residual_input", "residual_unit"),
    "residual_unit_and_bias",
)
"""Names of dimensions and other variables in posterior files."""
PREFIXES = ("told_", "truth_", "measured_")
"""Prefixes of variables of recordings, which sites must not have."""
MANY = 512
"""People that are drawn to see whether supports differ between them."""


def check_names(domain: Domain, sites: Iterable[str]) -> None:
    """Refuse names of sites that are reserved or invalid in posterior files."""
    taken = {*AXES, *(f"{m.name}_item" for m in domain.modalities)}
    taken |= {part for m in domain.modalities for part in (m.name, f"{m.name}_feature")}
    for name in sites:
        if not name.isprintable() or name != name.strip() or set(name) & {"/"}:
            raise HumanModelError(f'"{name}" cannot be the name of a site: use plain words')
        if name in taken or name.startswith(PREFIXES):
            raise HumanModelError(
                f'"{name}" cannot be the name of a site: posterior files reserve it'
            )


def refuse_parameters(trace: poutine.Trace) -> None:
    """Refuse ``pyro.param``, which has no prior."""
    for name, site in trace.nodes.items():
        if site["type"] == "param":
            raise HumanModelError(f'"{name}" is a pyro.param; sample it, so that it has a prior')


def refuse_plates(trace: poutine.Trace) -> None:
    """Refuse plates other than those of people and rounds."""
    for name, site in sample_nodes(trace).items():
        for frame in site["cond_indep_stack"]:
            if frame.dim is None:
                raise HumanModelError(
                    f'"{name}" is in the sequential plate "{frame.name}"; give its distribution '
                    ".to_event(1) in place of a plate"
                )
            if frame.dim < -PLATES:
                raise HumanModelError(
                    f'"{name}" is in the plate "{frame.name}" at dimension {frame.dim}, which '
                    "draws of people take; give its distribution .to_event(1) in place of a plate"
                )


def check_sites(trace: poutine.Trace, people: int) -> None:
    """Refuse sites that can be sampled but not inferred."""
    refuse_parameters(trace)
    refuse_plates(trace)
    for name, site in sample_nodes(trace).items():
        if site["is_observed"]:
            value = torch.as_tensor(site["value"])
            if value.numel():  # factors are empty
                check_plates(name, value[(..., *(0,) * site["fn"].event_dim)], people)
            check_plates(name, log_prob(site), people)
    latent = latent_sites(trace)
    if not latent:
        raise HumanModelError("prior samples no site, so there is nothing to infer")
    for name, site in latent.items():
        fn = site["fn"]
        _refuse_distribution(name, fn)
        if fn.support.is_discrete and not fn.has_enumerate_support:
            raise HumanModelError(
                f'"{name}" is discrete without finite support; it can be neither enumerated nor '
                "approximated"
            )
        if tuple(fn.batch_shape) != (people, 1):
            raise HumanModelError(
                f'"{name}" has batch shape {tuple(fn.batch_shape)}, expected ({people}, 1) for '
                f"{people} people; use .to_event() for several numbers a person"
            )


@torch.no_grad()
def check_supports(human: HumanModel) -> None:
    """Refuse sites whose possible values depend on other sites, or are not as they are declared.

    Many people are drawn, so that parents with few values differ between them.
    """
    with forked():
        seed_everything(0)
        for name, site in sample_sites(human, MANY).items():
            fn = site["fn"]
            support = getattr(fn.support, "base_constraint", fn.support)  # of .to_event()
            bounds = [bound for bound in vars(support).values() if torch.is_tensor(bound)]
            batch = len(fn.event_shape)  # bounds may differ between the numbers of a person
            of_people = [one.flatten(0, -1 - batch) for one in bounds if one.dim() > batch]
            if any(bool((one != one[:1]).any()) for one in of_people):
                raise HumanModelError(
                    f'what "{name}" can be depends on another site; sample it from 0 to 1, say, '
                    "and stretch it where it is read"
                )
            if not fn.support.is_discrete:
                _refuse_wrong_support(name, fn)


def _refuse_wrong_support(name: str, fn: Any) -> None:
    """Refuse a distribution that has a density where it draws, but not all over its support."""
    transform, drawn = biject_to(fn.support), fn.sample()
    if not bool(fn.log_prob(drawn).isfinite().all()):
        return
    place = transform.inv(drawn)
    # Around draws, as far away densities may be rounded to 0.
    place = place.mean(0) + 2 * place.std(0) * torch.randn_like(place)
    try:
        known = fn.log_prob(transform(place)).isfinite().all()
    except ValueError:  # of torch's validation
        known = False
    if not known:
        raise HumanModelError(
            f'"{name}" has no density at some values that its support, {fn.support}, allows; '
            "stretch or move values where they are read, in place of a transformed distribution"
        )


def check_sight(domain: Domain, trace: poutine.Trace) -> None:
    """Refuse thresholds of sight with more values than there are bins."""
    bins = len(domain.reach_bins)
    for name, site in latent_sites(trace).items():
        if name.startswith(SIGHT) and site["fn"].has_enumerate_support and not site["fn"].event_dim:
            values = len(site["fn"].enumerate_support(expand=False))
            if values > bins:
                raise HumanModelError(
                    f'"{name}" has {values} values, but {domain.name} has {bins} reach_bins; a '
                    f'site that is no threshold needs a name without "{SIGHT}"'
                )


def _refuse_distribution(name: str, fn: Any) -> None:
    """Refuse a distribution whose draws and densities engines cannot use together."""
    kind = fn
    while isinstance(kind, Independent):  # .to_event() of another
        kind = kind.base_dist
    if isinstance(kind, MaskedDistribution):
        raise HumanModelError(
            f'"{name}" is of a masked distribution, which draws values and has no density of them; '
            "put pyro.poutine.mask around pyro.sample in place of .mask()"
        )
    if isinstance(kind, dist.Delta):
        raise HumanModelError(
            f'"{name}" is of dist.Delta, so that nothing is to be inferred; write its value, or '
            "pyro.deterministic"
        )
    if isinstance(kind, dist.VonMises):
        raise HumanModelError(
            f'"{name}" is an angle, which has no proposals on the whole line; sample it from '
            "dist.Uniform, and give its density by pyro.factor"
        )
    if fn.support.is_discrete and fn.event_dim:
        raise HumanModelError(
            f'"{name}" is discrete with event shape {tuple(fn.event_shape)}; sample numbers, as '
            "from dist.Categorical, and convert them where they are read"
        )
    if not fn.support.is_discrete:
        try:
            biject_to(fn.support)
        except NotImplementedError:
            raise HumanModelError(
                f'values of "{name}" cannot be transformed to the whole line; for a mixture, '
                "sample the component from dist.Categorical and the value given it"
            ) from None

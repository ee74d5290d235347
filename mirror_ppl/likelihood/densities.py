"""Log densities of runs of a human program, as Pyro counts them.

Whatever a program samples, observes or adds by ``pyro.factor`` is a site of its trace, with the
scale and the mask of the handlers around it. What engines compute is made of these sites, so
nothing that a method of a human model says is left out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import pyro
import torch
from pyro import poutine
from pyro.distributions.util import scale_and_mask
from pyro.poutine.condition_messenger import ConditionMessenger
from torch import Tensor

from mirror_ppl.errors import HumanModelError
from mirror_ppl.models.human import ACTION, HumanModel, require_standard_program
from mirror_ppl.models.sites import sample_nodes

BATCH = 3
"""Dimensions of draws, people and their rounds; combinations of discrete values go before them."""
PLATES = 2
"""People and their rounds; what is summed over goes to the left of them."""
SPARE = 6
"""Dimensions that draws and enumeration may take to the left of people and rounds."""


def require_compilable(human: HumanModel) -> None:
    """Refuse human models whose program is not the one that is compiled.

    Raises:
        HumanModelError: this is one.
    """
    require_standard_program(human, "be compiled")
    # Of data of several people it is noticed here that they are no one person's.
    for name, node in prior_nodes(human, {}, 1, 1).items():
        check_plates(name, log_prob(node), 1)


def log_prob(node: Mapping[str, Any]) -> Tensor:
    """Log density of a node's value, scaled and masked."""
    found = node["fn"].log_prob(node["value"], *node["args"], **node["kwargs"])
    return torch.as_tensor(scale_and_mask(found, node["scale"], node["mask"]))


def correction(node: Mapping[str, Any]) -> Tensor | None:
    """By how much a node's log density differs from that of drawing its value; ``None`` if not.

    Of a factor or an observed site it is all of it, of a sampled one what scales and masks change.
    """
    if is_observed(node):
        return log_prob(node)
    if node["mask"] is None and isinstance(node["scale"], (int, float)) and node["scale"] == 1:
        return None
    return log_prob(node) - node["fn"].log_prob(node["value"])


def is_observed(node: Mapping[str, Any]) -> bool:
    """Whether a node is observed in the program itself, or a factor of it."""
    return node["is_observed"] and not node["infer"].get("was_given", False)


class Given(ConditionMessenger):
    """Conditions on values of sites, and marks these as given from outside of the program."""

    def _pyro_sample(self, msg: Any) -> None:
        super()._pyro_sample(msg)
        if msg["name"] in self.data:
            msg["infer"] = {**msg["infer"], "was_given": True}


def log_correction(
    human: HumanModel, sites: Mapping[str, Tensor], draws: Mapping[str, Tensor], people: int
) -> Tensor:
    """What ``prior`` adds to the density by which draws are proposed, ``[S, P]``.

    Its factors and observed sites, scales and masks, but for those that depend on the discrete
    sites that perception reads; they are part of
    :func:`~mirror_ppl.likelihood.combinations.log_priors`.

    Args:
        human: the model of people.
        sites: supports ``[n]`` of these discrete sites.
        draws: values of all other sites ``[S, P, 1, ...]``.
        people: number of people P.
    """
    two = {site: support[[0, -1]].view(2, 1, 1, 1) for site, support in sites.items()}
    number = len(next(iter(draws.values()))) if draws else 1
    total = next(human.parameters()).new_zeros(number, people, 1)
    for name, node in prior_nodes(human, {**draws, **two}, number, people).items():
        own = None if name in sites else correction(node)
        if own is not None and own.dim() <= BATCH:
            check_plates(name, own, people)
            total = total + own
    return total.squeeze(-1)


def whole_correction(
    human: HumanModel, draws: Mapping[str, Tensor], people: int, without: Collection[str]
) -> Tensor:
    """All that ``prior`` adds to the density ``[S, P]`` by which draws ``[S, P, 1, ...]`` are made.

    Args:
        human: the model of people.
        draws: of all sites.
        people: number of people P.
        without: names of sites whose own density does not count.
    """
    number = len(next(iter(draws.values())))
    total = next(human.parameters()).new_zeros(number, people, 1)
    for name, node in prior_nodes(human, draws, number, people).items():
        own = None if name in without else correction(node)
        if own is not None:
            check_plates(name, own, people)
            total = total + own
    return total.squeeze(-1)


def adds_to_prior(human: HumanModel) -> bool:
    """Whether ``prior`` is more than what it samples."""
    return any(correction(node) is not None for node in prior_nodes(human, {}, 1, 1).values())


def prior_nodes(
    human: HumanModel, given: Mapping[str, Tensor], number: int, people: int
) -> dict[str, Any]:
    """Nodes of ``prior`` for some draws, given values of sites."""
    with (
        torch.random.fork_rng(devices=[]),
        poutine.block(),
        poutine.trace() as trace,
        Given(dict(given)),
        pyro.plate("draw", number, dim=-3),
        pyro.plate("person", people, dim=-2),
    ):
        human.prior()
    return sample_nodes(trace.trace)


def check_plates(name: str, found: Tensor, people: int, rounds: int = 1) -> None:
    """Refuse a log density that is not one of each person (and round).

    Raises:
        HumanModelError: it has other dimensions, as data of other people have.
    """
    shape = (1, 1, *found.shape)[-2:]
    if shape[0] not in (1, people) or shape[1] not in (1, rounds):
        raise HumanModelError(
            f'"{name}" has a log density of shape {tuple(found.shape)}, expected one number for '
            f"each of {people} people and {rounds} rounds in its last two dimensions; what was "
            "measured of each person comes with the recordings, as their measurements"
        )


def choices(
    human: HumanModel,
    implants: Mapping[str, Tensor],
    belief: Tensor,
    values: Tensor,
    acted: Tensor,
) -> tuple[Tensor, Tensor]:
    """Log-probabilities ``[..., P, N, A]`` of actions at moments, and ``[..., P, N]`` of what was.

    The second is of everything that the program says at such a moment: of the recorded action, and
    of whatever else ``act`` observes or adds. Runs inside the person plate.

    Args:
        human: the model of people.
        implants: as :meth:`HumanModel.prior` returned them, ``[..., P, 1]``.
        belief: at each of N moments of each person, ``[P, N, Z]``.
        values: the self-model's action values there, ``[P, N, A]``.
        acted: what was done there, ``[P, N]``.
    """
    with (
        poutine.block(),
        poutine.trace() as trace,
        pyro.plate("round", belief.shape[-2], dim=-1),
    ):
        human.choose(implants, belief, values, acted)
    nodes = sample_nodes(trace.trace)
    for name, node in nodes.items():
        if not node["is_observed"]:
            raise HumanModelError(f'act samples "{name}" at every step; sample it in prior')
        if name != ACTION:
            check_plates(name, log_prob(node), belief.shape[-3], belief.shape[-2])
    each = [log_prob(node) for node in nodes.values()]
    total = each[0] if len(each) == 1 else torch.stack(torch.broadcast_tensors(*each)).sum(0)
    if bool(total.isnan().any()):
        raise HumanModelError(f"{type(human).__name__}.act returns nan")
    return nodes[ACTION]["fn"].logits, total


def log_latents(
    human: HumanModel,
    implants: Mapping[str, Tensor],
    values: Mapping[str, Tensor],
    covariates: Mapping[str, Tensor] | None = None,
) -> dict[str, Tensor]:
    """Log-probability ``[..., P, B, G]`` of G values of each round latent, by name.

    With all that ``round_latents`` observes or adds by a factor. Runs inside the person plate.

    Args:
        human: the model of people.
        implants: as :meth:`HumanModel.prior` returned them, ``[..., P, 1]``.
        values: of the sites, ``[P, B, G]``.
        covariates: of the rounds ``[P, B]``, see :meth:`HumanModel.covariates`.
    """
    # Far to the left of whatever dimensions draws and enumeration take.
    given = {
        name: value.movedim(-1, 0).reshape(value.shape[-1], *(1,) * SPARE, *value.shape[:-1])
        for name, value in values.items()
    }
    people, rounds = next(iter(values.values())).shape[:2]
    with (
        poutine.block(),
        poutine.trace() as trace,
        Given(given),
        pyro.plate("round", rounds, dim=-1),
    ):
        human.round_latents({**implants, **(covariates or {})})
    found = {}
    for name, node in sample_nodes(trace.trace).items():
        own = log_prob(node)
        check_plates(name, own, people, rounds)
        own = own.movedim(0, -1) if own.dim() == 1 + SPARE + 2 else own[..., None]
        while own.dim() > BATCH and own.shape[0] == 1:
            own = own.squeeze(0)
        found[name] = own
    return found


def log_weighted_latents(
    human: HumanModel,
    implants: Mapping[str, Tensor],
    values: Mapping[str, Tensor],
    log_weights: Tensor,
    covariates: Mapping[str, Tensor] | None = None,
) -> Tensor:
    """``log p(m_b | psi_p)`` of G values that stand for all in a round, ``[..., P, B, G]``.

    Runs inside the person plate. Each is multiplied by that for how many it stands, so that sums
    over the G values estimate sums over all of them without bias. They are therefore not divided by
    their own sum, which is 1 on average only: values are proposed by what was done, so that where
    few of them are probable of a person the actions would seem probable.

    Args:
        human: the model of people.
        implants: as :meth:`HumanModel.prior` returned them, ``[..., P, 1]``.
        values: of the round latents, ``[P, B, G]``.
        log_weights: for how many each of them stands, ``[P, B, G]``.
        covariates: of the rounds ``[P, B]``, see :meth:`HumanModel.covariates`.
    """
    found = log_latents(human, implants, values, covariates)
    return torch.stack(torch.broadcast_tensors(*found.values())).sum(0) + log_weights

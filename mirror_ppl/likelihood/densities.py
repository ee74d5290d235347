"""Log densities of runs of a human program, as Pyro counts them.

Everything that a program samples, observes or adds by ``pyro.factor`` is a site of its trace, with
the scale and the mask of the handlers around it. Engines compute densities from these sites, which
include everything that the methods of a human model add.
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
from mirror_ppl.randomness import forked

BATCH = 3
"""Dimensions of draws, people and rounds; combinations of discrete values are to their left."""
PLATES = 2
"""Dimensions of people and rounds; enumerated sites are to their left."""
SPARE = 6
"""Dimensions that draws and enumeration may take to the left of people and rounds."""


def require_compilable(human: HumanModel) -> None:
    """Refuse human models whose program is not the one that is compiled.

    Raises:
        HumanModelError: the model overrides its program.
    """
    require_standard_program(human, "be compiled")
    # Observed data of several people have the wrong shape for one person.
    for name, node in prior_nodes(human, {}, 1, 1).items():
        check_plates(name, log_prob(node), 1)


def log_prob(node: Mapping[str, Any]) -> Tensor:
    """Log density of a node's value, scaled and masked."""
    found = node["fn"].log_prob(node["value"], *node["args"], **node["kwargs"])
    return torch.as_tensor(scale_and_mask(found, node["scale"], node["mask"]))


def correction(node: Mapping[str, Any]) -> Tensor | None:
    """Difference of a node's log density and that of sampling its value; ``None`` if there is none.

    The whole density of factors and observed sites; of sampled sites the effect of scale and mask.
    """
    if node["infer"].get("_deterministic"):  # pyro.deterministic, whose density is 1
        return None
    if is_observed(node):
        return log_prob(node)
    if node["mask"] is None and isinstance(node["scale"], (int, float)) and node["scale"] == 1:
        return None
    return log_prob(node) - node["fn"].log_prob(node["value"])


def is_observed(node: Mapping[str, Any]) -> bool:
    """True if a node is a factor or an observed site of the program itself."""
    return node["is_observed"] and not node["infer"].get("was_given", False)


class Given(ConditionMessenger):
    """Effect handler that conditions on values of sites, and marks them as given from outside."""

    def _pyro_sample(self, msg: Any) -> None:
        super()._pyro_sample(msg)
        if msg["name"] in self.data:
            msg["infer"] = {**msg["infer"], "was_given": True}


def log_correction(
    human: HumanModel, sites: Mapping[str, Tensor], draws: Mapping[str, Tensor], people: int
) -> Tensor:
    """Log density ``[S, P]`` that ``prior`` adds to that of sampling its draws.

    Sums its factors, observed sites, scales and masks. Those that depend on the sites that
    perception reads are excluded; they are part of
    :func:`~mirror_ppl.likelihood.combinations.log_priors`.

    Args:
        human: the model of people.
        sites: values ``[n, ...]`` of these sites, of which the first and the last are tried.
        draws: values of all other sites ``[S, P, 1, ...]``.
        people: number of people P.
    """
    two = {site: value[[0, -1]][:, None, None, None] for site, value in sites.items()}
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
    """Log density ``[S, P]`` that ``prior`` adds to that of sampling draws ``[S, P, 1, ...]``.

    Args:
        human: the model of people.
        draws: values of all sites.
        people: number of people P.
        without: names of sites whose own density is excluded.
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
    """True if ``prior`` has factors, observed sites, scales or masks."""
    return any(correction(node) is not None for node in prior_nodes(human, {}, 1, 1).values())


def prior_nodes(
    human: HumanModel, given: Mapping[str, Tensor], number: int, people: int
) -> dict[str, Any]:
    """Trace nodes of ``prior`` for ``number`` draws, given values of sites."""
    with (
        forked(),
        poutine.block(),
        poutine.trace() as trace,
        Given(dict(given)),
        pyro.plate("draw", number, dim=-3),
        pyro.plate("person", people, dim=-2),
    ):
        human.prior()
    return sample_nodes(trace.trace)


def check_plates(name: str, found: Tensor, people: int, rounds: int = 1) -> None:
    """Refuse a log density without one number for each person (and round).

    Raises:
        HumanModelError: it has other dimensions, as with data of other people.
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
    *,
    powered: bool = True,
) -> tuple[Tensor, Tensor]:
    """Log-probabilities of actions ``[..., P, N, A]`` and of the record ``[..., P, N]`` at moments.

    The second includes the recorded action and everything else that ``act`` observes or adds. Runs
    inside the person plate.

    Args:
        human: the model of people.
        implants: as :meth:`HumanModel.prior` returned them, ``[..., P, 1]``.
        belief: belief at each of N moments of each person, ``[P, N, Z]``.
        values: the self-model's action values there, ``[P, N, A]``.
        acted: the recorded action there, ``[P, N]``.
        powered: whether recorded actions count as often as in posteriors
            (:attr:`HumanModel.likelihood_power`); False for predictions, in which they count once.
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
    each = [log_prob(node) / (1.0 if powered else power_of(node["fn"])) for node in nodes.values()]
    total = each[0] if len(each) == 1 else torch.stack(torch.broadcast_tensors(*each)).sum(0)
    if bool(total.isnan().any()):
        raise HumanModelError(f"{type(human).__name__}.act returns nan")
    return nodes[ACTION]["fn"].logits, total


def power_of(distribution: Any) -> float:
    """Return the power of a distribution's probabilities in the density; 1 for most."""
    return getattr(distribution, "power", 1.0)


def log_latents(
    human: HumanModel,
    implants: Mapping[str, Tensor],
    values: Mapping[str, Tensor],
    covariates: Mapping[str, Tensor] | None = None,
) -> dict[str, Tensor]:
    """Log-probability ``[..., P, B, G]`` of G values of each round latent, by name.

    Includes factors and observed sites of ``round_latents``. Runs inside the person plate.

    Args:
        human: the model of people.
        implants: as :meth:`HumanModel.prior` returned them, ``[..., P, 1]``.
        values: values of the sites, ``[P, B, G]``.
        covariates: covariates of the rounds ``[P, B]``, see :meth:`HumanModel.covariates`.
    """
    # Far to the left of the dimensions of draws and enumeration.
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
    """Weighted ``log p(m_b | psi_p)`` of G sampled values of a round, ``[..., P, B, G]``.

    Runs inside the person plate. With the inverse inclusion probabilities as weights, sums over the
    G values are unbiased estimates of sums over all values. They are not normalized: their sum is 1
    on average only, and the proposal depends on the recorded actions, so normalizing would favour
    people for whom few of the G values are probable.

    Args:
        human: the model of people.
        implants: as :meth:`HumanModel.prior` returned them, ``[..., P, 1]``.
        values: values of the round latents, ``[P, B, G]``.
        log_weights: log inverse inclusion probabilities, ``[P, B, G]``.
        covariates: covariates of the rounds ``[P, B]``, see :meth:`HumanModel.covariates`.
    """
    found = log_latents(human, implants, values, covariates)
    return torch.stack(torch.broadcast_tensors(*found.values())).sum(0) + log_weights

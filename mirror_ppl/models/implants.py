"""Priors of implants, what distinguishes a person from the robot (supplement, section C).

Perceptual implants are what a person sees and assumes about the rest; policy implants are how they
decide. Each is a sample site of the human model, with one value per person.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain
from mirror_ppl.domains.controls import execution

SIGHT = "sight_"
"""Prefix of the sites of directional sight thresholds, one for each direction of the domain."""
ASSUMES = "assumes_"
"""Prefix of the sites of assumptions a person makes, one for each assumption of the domain."""
NOTICES, NOTICED = "notices_", "noticed_"
"""Prefixes of the sites of each item's probability of being noticed at a step, and of the step."""
LEAST_PROBABILITY = 1e-6
"""Probabilities are clamped to at least this distance from 0 and 1, so logarithms are finite."""
CONSISTENCY_SPREAD = 0.5
"""Prior SD of the logarithm of consistency."""
RESIDUAL = ("residual_in", "residual_out")
"""Sites of the residual's weights."""
RESIDUAL_HIDDEN = 8
MOTOR_NOISE = "motor_noise"
"""Site of the standard deviation of executed controls, in distances between levels of the grid."""
MOTOR_NOISE_MEDIAN, MOTOR_NOISE_SPREAD = 0.3, 0.7
"""Prior median of the motor noise; prior SD of its logarithm."""


def sight_sites(domain: Domain) -> tuple[str, ...]:
    """Names of the sites of sight thresholds, in the order of the domain's directions."""
    return tuple(SIGHT + direction for direction in domain.directions)


def assumption_sites(domain: Domain) -> tuple[str, ...]:
    """Names of the sites of assumptions, in the order of the domain."""
    return tuple(ASSUMES + assumption for assumption in domain.assumptions)


def perceptual_implants(
    domain: Domain, like: Tensor, assumption_probability: float = 0.5
) -> dict[str, Tensor]:
    """Sample what a person sees and assumes, as indices that can be enumerated.

    ``sight_<direction>`` is an index into the domain's ``reach_bins``. The data identify a
    threshold only up to the distances that can occur, so these bins lose nothing. The prior is
    uniform, except in worlds whose record has a ``sight_scale``: there, each direction depends on
    the first one of its group (`alike`).
    """
    sites, scale = sight_sites(domain), domain.record.sight_scale
    implants: dict[str, Tensor] = {}
    if scale is not None:
        given = alike(len(domain.reach_bins), scale).to(like)
        for first, *others in domain.direction_groups:
            implants[sites[first]] = reach_implant(sites[first], domain, like)
            near = given[implants[sites[first]]]
            for place in others:
                implants[sites[place]] = reach_implant(sites[place], domain, like, near)
    for site in sites:
        if site not in implants:
            implants[site] = reach_implant(site, domain, like)
    return implants | assumption_implants(domain, like, assumption_probability)


def reach_implant(
    site: str, domain: Domain, like: Tensor, probability: Tensor | None = None
) -> Tensor:
    """Sample how far a person sees, as an index into the domain's ``reach_bins``.

    Args:
        site: name of the site.
        domain: the world.
        like: a tensor of the dtype and on the device of the prior.
        probability: of each bin, ``[..., bins]``; equal unless given.
    """
    if probability is None:
        bins = torch.ones(len(domain.reach_bins), dtype=like.dtype, device=like.device)
        probability = bins / bins.sum()
    return pyro.sample(site, dist.Categorical(probability))


def alike(bins: int, scale: float) -> Tensor:
    """Return ``p(i | j)``, ``[j, i]``, of bins of reach: proportional to ``exp(-|i - j| / scale)``.

    People mostly see about equally far in directions next to each other. At a distance of
    ``scale`` bins the probability is 1/e of that of the same bin.
    """
    place = torch.arange(bins, dtype=torch.get_default_dtype())
    return torch.softmax(-(place - place[:, None]).abs() / scale, -1)


def noticed_sites(domain: Domain) -> tuple[str, ...]:
    """Names of the sites of the step at which items are noticed, in the order of visual items."""
    return tuple(NOTICED + item for item in _visual_items(domain))


def notice_implants(
    domain: Domain, like: Tensor, success: Tensor | float = 1.0, failure: Tensor | float = 1.0
) -> dict[str, Tensor]:
    """Sample a person's probability of noticing each item at a step: ``notices_<item>``.

    The prior is a Beta density, uniform unless its parameters are given.
    """
    first, second = (torch.as_tensor(part).to(like) for part in (success, failure))
    return {
        site: pyro.sample(site, dist.Beta(first, second))
        for site in (NOTICES + item for item in _visual_items(domain))
    }


def notice_times(domain: Domain, implants: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Sample the step of a round at which each item is noticed: ``noticed_<item>``, from 0.

    Geometric, truncated at the domain's horizon, which stands for never.
    """
    return {
        NOTICED + item: pyro.sample(
            NOTICED + item, first_success(implants[NOTICES + item], domain.horizon)
        )
        for item in _visual_items(domain)
    }


def first_success(probability: Tensor, trials: int) -> dist.Categorical:
    """Return the distribution of failures before the first success, a truncated geometric.

    Args:
        probability: of success in a trial, ``[...]``.
        trials: number of trials; the support is 0 to this number, which stands for no success.
    """
    probability = probability.clamp(LEAST_PROBABILITY, 1 - LEAST_PROBABILITY)[..., None]
    failures = torch.arange(trials + 1, device=probability.device)
    success = torch.where(failures < trials, torch.log(probability), 0.0)
    return dist.Categorical(logits=failures * torch.log1p(-probability) + success)


def _visual_items(domain: Domain) -> tuple[str, ...]:
    return next(m.items for m in domain.modalities if m.name == "visual")


def assumption_implants(
    domain: Domain, like: Tensor, probability: float = 0.5
) -> dict[str, Tensor]:
    """Sample what a person takes for granted: ``assumes_<assumption>``, 1 if they do.

    0 stands for a person who, like the robot, does not assume it. ``probability`` is the prior
    probability of 1.
    """
    open_or_taken = torch.tensor(
        [1 - probability, probability], dtype=like.dtype, device=like.device
    )
    return {
        site: pyro.sample(site, dist.Categorical(open_or_taken))
        for site in assumption_sites(domain)
    }


def policy_implants(
    domain: Domain, latent: int, like: Tensor, lapse: float = 1 / 31
) -> dict[str, Tensor]:
    """Sample how a person decides and acts: choice parameters, residual, noise of controls."""
    return choice_implants(domain, like, lapse) | residual_implants(domain, latent, like)


def choice_implants(domain: Domain, like: Tensor, lapse: float = 1 / 31) -> dict[str, Tensor]:
    """Sample the parameters of a person's choices.

    - ``consistency``: inverse temperature of the choice between action values, per unit of reward;
      the world's record has its prior median;
    - ``lapse``: probability that an action is independent of the belief; the argument ``lapse``
      is its prior mean;
    - ``motor_noise``, only where actions are continuous: standard deviation of what a person
      executes around what they intend, in distances between levels of the grid
      (:mod:`mirror_ppl.domains.controls`).
    """

    def number(value: float) -> Tensor:
        return torch.tensor(value, dtype=like.dtype, device=like.device)

    sampled = {
        "consistency": pyro.sample(
            "consistency",
            dist.LogNormal(number(math.log(domain.record.consistency)), number(CONSISTENCY_SPREAD)),
        ),
        "lapse": pyro.sample("lapse", dist.Beta(number(1.0), number(1 / lapse - 1))),
    }
    if domain.controls:
        noise = dist.LogNormal(number(math.log(MOTOR_NOISE_MEDIAN)), number(MOTOR_NOISE_SPREAD))
        sampled[MOTOR_NOISE] = pyro.sample(MOTOR_NOISE, noise)
    return sampled


def executed(domain: Domain, implants: Mapping[str, Tensor], intended: Tensor) -> Tensor:
    """Return log-probabilities of executed actions ``[..., P, B, A]`` from those of intended ones.

    They are equal where actions are numbered, or ``motor_noise`` is not sampled.
    """
    if MOTOR_NOISE not in implants:
        return intended
    slips = execution(domain.controls, implants[MOTOR_NOISE])  # [..., P, 1, A, A]
    if slips.shape[-3] == 1:  # the rounds of a person share it
        found = intended.exp() @ slips.squeeze(-3)
    else:
        found = (intended.exp()[..., None, :] @ slips).squeeze(-2)
    return torch.log(found.clamp(min=torch.finfo(found.dtype).tiny))


def residual_implants(domain: Domain, latent: int, like: Tensor) -> dict[str, Tensor]:
    """Sample the residual by which a person's policy differs from the robot's.

    ``residual_in`` ``[..., Z + 1, R]`` and ``residual_out`` ``[..., R + 1, A]`` are weights (the
    last row is the bias) of the network of the residual ``delta(zH_t)``. The prior keeps its output
    small (about 0.3 on logits), because a large residual can imitate blindness.
    """

    def weights(rows: int, columns: int, scale: float) -> dist.TorchDistribution:
        zero = torch.zeros(rows, columns, dtype=like.dtype, device=like.device)
        return dist.Normal(zero, scale).to_event(2)

    return {
        "residual_in": pyro.sample(
            "residual_in", weights(latent + 1, RESIDUAL_HIDDEN, latent**-0.5)
        ),
        "residual_out": pyro.sample(
            "residual_out", weights(RESIDUAL_HIDDEN + 1, len(domain.actions), 0.1)
        ),
    }


def reach(domain: Domain, implants: Mapping[str, Tensor]) -> Tensor:
    """Return sight thresholds ``[..., D]`` in the domain's unit of distance."""
    return _looked_up(domain, implants, domain.reach_bins)


def sight_limits(domain: Domain, implants: Mapping[str, Tensor]) -> Tensor:
    """Return the distances ``[..., D]`` up to which people see: infinite for the last threshold.

    The last threshold is everything, also where rare distances exceed it.
    """
    return _looked_up(domain, implants, (*domain.reach_bins[:-1], math.inf))


def _looked_up(domain: Domain, implants: Mapping[str, Tensor], values: Sequence[float]) -> Tensor:
    """Return the value ``[..., D]`` of each direction's bin."""
    sites = [implants[site] for site in sight_sites(domain)]
    bins = torch.tensor(values, device=sites[0].device)
    # Stacking in front copies whole blocks; a hundred thousand combinations are looked up.
    index = torch.stack(torch.broadcast_tensors(*sites))
    return bins.index_select(0, index.flatten()).view(index.shape).movedim(0, -1)


def in_units(domain: Domain, draws: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Squeeze draws ``[S, P, 1, ...]`` to ``[S, P, ...]``; sight bins become distances."""
    bins = torch.tensor(domain.reach_bins)
    return {
        name: (bins[value] if is_reach(name, value) else value).squeeze(2)
        for name, value in draws.items()
    }


def is_reach(name: str, value: Tensor) -> bool:
    """True if draws of a site are indices into the domain's ``reach_bins``."""
    return name.startswith(SIGHT) and not value.is_floating_point()


def residual(implants: Mapping[str, Tensor], belief: Tensor) -> Tensor:
    """Return ``delta(zH_t)`` ``[..., P, B, A]`` of beliefs ``[..., P, B, Z]``; 0 if not sampled."""
    if "residual_in" not in implants:
        return belief.new_zeros(())
    return _layer(implants["residual_out"], _hidden(implants, belief))


def residual_features(implants: Mapping[str, Tensor], belief: Tensor) -> Tensor:
    """Return the features that ``residual_out`` weighs, ``[..., P, B, R + 1]``."""
    return torch.nn.functional.pad(_hidden(implants, belief), [0, 1], value=1.0)


def _hidden(implants: Mapping[str, Tensor], belief: Tensor) -> Tensor:
    """Return the hidden layer of the residual's network, ``[..., P, B, R]``."""
    # tanh(x) = 2 sigmoid(2 x) - 1, which torch computes three times as fast.
    return 2 * torch.sigmoid(2 * _layer(implants["residual_in"], belief)) - 1


def _layer(weights: Tensor, inputs: Tensor) -> Tensor:
    """Apply per-person linear weights ``[..., P, 1, I + 1, O]`` to inputs ``[..., P, B, I]``.

    Outputs of a unit for all beliefs are next to each other in memory, so that products and sums
    over few units or actions are fast.
    """
    if weights.dim() > 2 and weights.shape[-3] == 1:
        # The rounds of a person share the weights: one product for all of them.
        weights = weights.squeeze(-3)
        if weights.dim() == inputs.dim() + 1:
            return _of_all_draws(weights, inputs)
        return (weights[..., :-1, :].mT @ inputs.mT + weights[..., -1:, :].mT).mT
    return (inputs[..., None, :] @ weights[..., :-1, :]).squeeze(-2) + weights[..., -1, :]


def _of_all_draws(weights: Tensor, inputs: Tensor) -> Tensor:
    """Apply S draws of weights ``[S, ..., I + 1, O]`` to shared inputs ``[..., B, I]`` at once."""
    draws, outputs = weights.shape[0], weights.shape[-1]
    joined = weights.mT.movedim(0, -3).flatten(-3, -2)  # [..., S O, I + 1]
    product = joined[..., :-1] @ inputs.mT + joined[..., -1:]
    return product.unflatten(-2, (draws, outputs)).movedim(-3, 0).mT

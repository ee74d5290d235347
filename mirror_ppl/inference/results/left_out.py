"""Predictions of each training round from the others, by the model and by action shares.

The model is not fitted anew without each round. Its posterior draws are weighted instead (PSIS-LOO:
Vehtari, Gelman and Gabry, *Practical Bayesian model evaluation using leave-one-out cross-validation
and WAIC*, 2017).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.inference.pareto import pareto_smoothed
from mirror_ppl.inference.results.posterior_predictive import chosen_log_probability
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel

LEAST_ROUNDS = 2
"""Least number of rounds: one has no others."""


@dataclass(frozen=True)
class LeftOut:
    """Predictions of one person's B training rounds, each from the others.

    Attributes:
        model: log predictive density of each round's actions, nats ``[B]``.
        shares: log density under the person's action shares in the other rounds, nats ``[B]``.
        actions: number of actions in all of these rounds.
        pareto_k: largest Pareto k of the rounds; above .7 the model's density is unreliable, and
            mostly too high.
    """

    model: Tensor
    shares: Tensor
    actions: int
    pareto_k: float

    @property
    def difference(self) -> Tensor:
        """Log density of each round by the model minus that by action shares ``[B]``."""
        return self.model - self.shares


def left_out(human: HumanModel, train: Demonstrations, log_probabilities: Tensor) -> LeftOut | None:
    """Predict each training round of one person from the others.

    Actions of a round are predicted step by step, as in held-out rounds: nothing is learned of the
    person within it.

    Args:
        human: the model of people.
        train: training rounds, on the CPU.
        log_probabilities: of actions there under posterior draws, ``[S, 1, B, T, A]``.

    Returns:
        The predictions. ``None`` with fewer than :data:`LEAST_ROUNDS` rounds, and where posterior
        draws cannot be weighted by actions: if ``act`` or ``round_latents`` adds terms besides
        them, or if decisions count less than once and attention is sampled.
    """
    real = train.mask[0].any(-1)
    power = human.likelihood_power
    cannot = dependencies(human).adds_to_rounds or (power != 1 and human.has_round_latents)
    if cannot or int(real.sum()) < LEAST_ROUNDS:
        return None
    chosen = chosen_log_probability(log_probabilities, train)[:, 0, real]  # [S, B, T]
    found, most = [], -math.inf
    for own in chosen.double().unbind(1):
        density, k = _without(own, power)
        found.append(density)
        most = max(most, k)
    actions = log_probabilities.shape[-1]
    done = torch.nn.functional.one_hot(train.actions[0, real].clamp(min=0), actions)
    counts = (done * train.mask[0, real][..., None]).sum(1)  # [B, A]
    others = (counts.sum(0) - counts).double() + 1 / 2  # as in the shares of all rounds
    shares = (counts * (others / others.sum(-1, True)).log()).sum(-1)
    return LeftOut(torch.stack(found), shares, int(counts.sum()), most)


def _without(log_probabilities: Tensor, power: float) -> tuple[Tensor, float]:
    """Log density of one round's actions given the other rounds, and its Pareto k.

    Args:
        log_probabilities: of the actions under draws from the posterior of all rounds, ``[S, T]``.
        power: :attr:`HumanModel.likelihood_power`.
    """
    density = log_probabilities.sum(-1)
    possible = density.isfinite()
    if not bool(possible.any()):
        return density.new_tensor(-math.inf), math.inf
    weights, k = pareto_smoothed(-power * density[possible])
    return torch.logsumexp(weights[:, None] + log_probabilities[possible], 0).sum(), k

"""The loss of self-model training, of rounds under views."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.models.networks import BinnedQNetwork
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.training.experience import Experience
from mirror_ppl.training.self_model_options import SelfModelOptions


@dataclass(frozen=True)
class Loss:
    """Parts of the loss of one gradient step; ``bellman`` is the mean squared error of values."""

    total: Tensor
    negative_elbo: Tensor
    bellman: Tensor


def self_model_loss(
    self_model: SelfModel,
    target: torch.nn.Module,
    lived: Experience,
    options: SelfModelOptions,
    on_means: bool,
) -> Loss:
    """Loss of a batch of rounds.

    Args:
        self_model: the model to train.
        target: target network, the slow copy of its Q-network.
        lived: rounds and outcomes.
        options: settings.
        on_means: True to learn values at the encoder's means, which all other code uses as beliefs;
            False for draws of the guide, which keep it precise about what values depend on.
            Training alternates.
    """
    rounds = lived.rounds
    evidence = self_model.evidence(rounds.observation, rounds.visible, rounds.actions)
    bound, z = self_model.elbo(rounds, evidence)
    batch, steps = rounds.actions.shape
    negative_elbo = -bound / (batch * (steps + 1))
    belief = z[:, :-1]
    if on_means:
        belief = self_model.believe(evidence[:, :-1])
    belief = belief[:, lived.steps]
    goal = (
        lived.exact if options.distil else _bootstrapped(self_model, target, lived, options, belief)
    )
    assert goal is not None
    # Once a round is over (possibly in every round) actions do not matter.
    live = ~lived.over
    belief, goal, sure = belief[live], goal[live], lived.informed[live]
    network = self_model.q_network
    if isinstance(network, BinnedQNetwork):
        predicted = network.log_probabilities(belief)
        values = network.mean(predicted)
        target_bins = network.target(goal)
        fit = options.bin_weight * _cross_entropy(target_bins, predicted)
        if options.ranked_weight:
            apart = network.ranked_cross_entropy(target_bins, predicted)
            fit = fit + options.ranked_weight * _mean(apart)
        bellman = _mean((values.detach() - goal).pow(2))
    else:
        values = self_model.action_values(belief)
        error = values - goal
        bellman = _mean(error.pow(2))
        fit = bellman
        if options.difference_weight:
            unlike = error - error.mean(-1, keepdim=True)
            fit = fit + options.difference_weight * _mean(unlike.pow(2))
    total = options.world_weight * negative_elbo + fit
    if options.choice_weight:
        chosen, likely = torch.softmax(goal[sure], -1), torch.log_softmax(values[sure], -1)
        total = total + options.choice_weight * _cross_entropy(chosen, likely)
    if options.regret_weight:
        behind = goal[sure].amax(-1, keepdim=True) - goal[sure]
        counted = torch.relu(behind - options.regret_margin)
        regret = (torch.softmax(values[sure], -1) * counted).sum(-1)
        total = total + options.regret_weight * _mean(regret)
    return Loss(total, negative_elbo.detach(), bellman.detach())


def _cross_entropy(goal: Tensor, log_probabilities: Tensor) -> Tensor:
    """Return the mean cross entropy ``-sum goal log_probabilities`` over the last dimension."""
    return _mean(-(goal * log_probabilities).sum(-1))


def _mean(each: Tensor) -> Tensor:
    """Return the mean; 0 of nothing."""
    return each.mean() if each.numel() else each.sum()


def _bootstrapped(
    self_model: SelfModel,
    target: torch.nn.Module,
    lived: Experience,
    options: SelfModelOptions,
    belief: Tensor,
) -> Tensor:
    """Return the goals ``[B, T', A]`` of action values at beliefs ``[B, T', Z]``."""
    steps = lived.rounds.actions.shape[1]
    goals = []
    with torch.no_grad():
        for action, outcome in enumerate(lived.outcomes):
            symbols = self_model.domain.symbols(outcome.observation)
            evidence = self_model.encoder.evidence(symbols, outcome.visible)
            evidence = evidence + self_model.encoder.action.weight[action]
            value = target(self_model.encoder(belief, evidence).mean).amax(-1)
            over = outcome.over
            if self_model.domain.over_at_horizon and steps == self_model.domain.horizon:
                over = over | (torch.arange(steps, device=over.device) == steps - 1)[lived.steps]
            goals.append(outcome.reward + options.discount * value.masked_fill(over, 0.0))
    goal = torch.stack(goals, -1)
    if lived.exact is not None:
        goal = torch.where(lived.informed[..., None], lived.exact, goal)
    return goal

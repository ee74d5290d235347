"""Maximum-entropy inverse reinforcement learning of drivers' rewards (supplement, section B).

Finds the posterior mode of the reward, given the actions of people who follow the policy of maximum
causal entropy. With features ``f`` of what a step leads to and weights ``w``:

- ``r(s, a) = w . f(s, a)``
- ``Q(a, m_t)``: soft action values, the maximum over actions replaced by ``log sum exp``, over the
  next H steps and the cars that the driver knew at t, planned anew at each step
- ``p(a_t | m_t) = softmax(Q(., m_t))``
- ``p(w) = Normal(0, prior_scale)``, weak

Features (supplement): distance to the centre of the road, distance to the cars (indicators of a car
of the ego's lane at 0 to 4 cells, one weight for all cars), and the action (1 for switching lanes).
Both lanes are equally far from the centre and no action leaves them, so the first feature is
constant: its weight is not identified by the data and stays at its prior mean of 0.

Departures: the scale of the reward and the consistency of drivers are not separately identified
(only their product is), so weights are reported on the scale on which switching costs 1, as in the
task; features are indicators instead of distances, because a reward that is linear in distance
cannot express the task's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.domains.driving.lane_values import action_values
from mirror_ppl.domains.driving.rewards import lane_rewards
from mirror_ppl.errors import DemonstrationsError
from mirror_ppl.minimization import minimize

CENTRE, SWITCH = "centre_distance", "switch"
CAR_DISTANCES = 5
"""Number of weights of cars of the ego's lane, at 0, 1, ... cells."""
FEATURES = (CENTRE, *(f"car_at_{cells}" for cells in range(CAR_DISTANCES)), SWITCH)
CENTRE_DISTANCE = 0.5
"""Distance in lanes of either lane's middle to the centre of the road."""


@dataclass(frozen=True)
class Decisions:
    """N decisions of drivers, with the knowledge that each was based on.

    Attributes:
        lane: the driver's lane ``[N]``.
        known: boolean ``[N, K]``, the cars they knew.
        position: believed positions ``[N, K]``, cells ahead.
        speed: believed relative speeds ``[N, K]``, cells per step.
        action: their action ``[N]``, 0 stay, 1 switch.
    """

    lane: Tensor
    known: Tensor
    position: Tensor
    speed: Tensor
    action: Tensor


@dataclass(frozen=True)
class LearnedReward:
    """A reward learned from recordings, scaled such that switching lanes costs 1.

    Attributes:
        weights: by name (``FEATURES``), in units of the task's reward.
        standard_errors: of the weights, by name: from the curvature of the posterior, propagated
            through the scaling. That of the weight which sets the scale is 0.
        scale: divisor of the weights, an estimate of the drivers' mean consistency in 1 / units
            of reward.
        scale_error: its standard error.
    """

    weights: Mapping[str, float]
    standard_errors: Mapping[str, float]
    scale: float
    scale_error: float

    @property
    def switch(self) -> float:
        """Reward of switching lanes."""
        return self.weights[SWITCH]

    def car_weights(self, device: torch.device | None = None) -> Tensor:
        """Reward of a car of the ego's lane by its distance in cells, ``[CAR_DISTANCES]``."""
        return torch.tensor([self.weights[name] for name in FEATURES[1:-1]], device=device)


def log_policy(weights: Tensor, decisions: Decisions, horizon: int, discount: float) -> Tensor:
    """Return log-probabilities ``[N, A]`` of actions under the maximum causal entropy policy.

    Args:
        weights: ``[len(FEATURES)]``, differentiable.
        decisions: states and knowledge; the actions are not used.
        horizon: number of steps planned ahead.
        discount: per step.
    """
    rewards = lane_rewards(
        decisions.position, decisions.speed, decisions.known, horizon, weights[1:-1]
    )
    rewards = rewards + CENTRE_DISTANCE * weights[0]
    return action_values(rewards, decisions.lane, weights[-1], discount, 1.0).log_softmax(-1)


def learn_reward(
    decisions: Decisions,
    horizon: int,
    discount: float,
    prior_scale: float = 30.0,
    iterations: int = 100,
) -> LearnedReward:
    """Learn the reward that explains decisions; deterministic.

    Args:
        decisions: pooled over people, rounds and steps.
        horizon: number of steps that the drivers planned ahead.
        discount: per step.
        prior_scale: standard deviation of the prior of each weight, before they are scaled.
        iterations: of L-BFGS, at most.

    Raises:
        DemonstrationsError: the learned cost of switching lanes is not positive, so the weights
            cannot be scaled by it.
    """

    def loss(weights: Tensor) -> Tensor:
        taken = log_policy(weights, decisions, horizon, discount)
        log_likelihood = taken.gather(-1, decisions.action[:, None]).sum()
        return 0.5 * (weights / prior_scale).square().sum() - log_likelihood

    device = decisions.lane.device
    weights = torch.zeros(len(FEATURES), dtype=torch.float64, device=device, requires_grad=True)
    minimize(lambda: loss(weights), [weights], iterations, tolerance_grad=1e-6)
    mode = weights.detach()
    hessian = torch.autograd.functional.hessian(loss, mode)
    assert isinstance(hessian, Tensor)
    return _scaled(mode.cpu(), torch.linalg.inv(hessian).cpu())


def _scaled(mode: Tensor, covariance: Tensor) -> LearnedReward:
    scale = -mode[-1].item()
    if scale <= 0:
        raise DemonstrationsError(
            "no reward can be learned from recordings in which switching lanes costs nothing"
        )
    weights = mode / scale
    # d(w_i / scale) / d(w_j), where the scale is minus the last weight.
    jacobian = torch.eye(len(mode), dtype=mode.dtype) / scale
    jacobian[:, -1] += weights / scale
    errors = (jacobian @ covariance @ jacobian.T).diagonal().clamp(min=0.0).sqrt()
    return LearnedReward(
        weights=dict(zip(FEATURES, weights.tolist(), strict=True)),
        standard_errors=dict(zip(FEATURES, errors.tolist(), strict=True)),
        scale=scale,
        scale_error=covariance[-1, -1].sqrt().item(),
    )

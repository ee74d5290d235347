"""Rewards of driving: of lanes at the next steps, and values of planners who know some cars."""

from __future__ import annotations

import torch
from torch import Tensor

from mirror_ppl.domains.driving.cars import CAR_LANES, DrivingState
from mirror_ppl.domains.driving.lane_values import action_values

NEAR = 2
"""Cars of the ego's lane at most this many cells away incur the proximity penalty."""
PROXIMITY, COLLISION, OFF_ROAD, LANE_CHANGE = -2.0, -5.0, -5.0, -1.0


def lane_rewards(
    position: Tensor, speed: Tensor, known: Tensor, horizon: int, weights: Tensor
) -> Tensor:
    """Return rewards of being in each lane at the next steps, given the known cars.

    Args:
        position: cells ahead ``[..., 4]``.
        speed: relative speed ``[..., 4]`` in cells per step.
        known: known cars ``[..., 4]``; the others are assumed absent.
        horizon: number of steps H.
        weights: reward of a car of the same lane by its distance in cells, ``[D]`` or
            ``[..., D]``; cars at D cells and beyond do not matter.

    Returns:
        ``[..., H, 2]``: entry (h, lane) is the reward at step h + 1.
    """
    steps = torch.arange(1, horizon + 1, device=position.device)
    gap = (position[..., None, :] + speed[..., None, :] * steps[:, None]).abs().long()
    number = weights.shape[-1]
    near = known[..., None, :] & (gap < number)
    shape = gap.shape[:-1]
    table = weights[..., None, :].expand(*shape, number)
    value = torch.where(near, table.gather(-1, gap.clamp(max=number - 1)), 0.0)
    lanes = torch.tensor(CAR_LANES, device=position.device)
    return torch.stack([(value * (lanes == lane)).sum(-1) for lane in range(2)], -1)


def task_weights(device: torch.device | None = None) -> Tensor:
    """Return rewards of a car of the ego's lane at 0, 1, ..., ``NEAR`` cells, ``[NEAR + 1]``."""
    weights = torch.full((NEAR + 1,), PROXIMITY, device=device)
    weights[0] += COLLISION
    return weights


def known_car_values(state: DrivingState, known: Tensor, horizon: int, discount: float) -> Tensor:
    """Return action values ``[..., 2]`` of the task for a planner that knows some of the cars.

    Args:
        state: positions and speeds of these cars; those of others are not used.
        known: ``[..., 4]``; unknown cars are assumed absent.
        horizon: number of steps planned ahead.
        discount: discount per step.
    """
    rewards = lane_rewards(
        state.position, state.speed, known, horizon, task_weights(state.position.device)
    )
    return action_values(rewards, state.lane, LANE_CHANGE, discount)

"""Exact action values on two lanes by backward induction.

Cars never react to the ego, so an action changes only the lane. Given the reward of being in each
lane at each future step, two values per step solve the problem.
"""

from __future__ import annotations

import torch
from torch import Tensor


def action_values(
    lane_rewards: Tensor,
    lane: Tensor,
    switch_reward: Tensor | float,
    discount: float,
    temperature: Tensor | float | None = None,
) -> Tensor:
    """Return action values ``[..., 2]`` (stay, switch) at the present step.

    Args:
        lane_rewards: ``[..., H, 2]``, reward of being in each lane at the next H steps.
        lane: present lane ``[...]``, 0 or 1.
        switch_reward: reward of switching lanes, a number or ``[...]``.
        discount: discount per step.
        temperature: ``None`` for the optimal values; a positive number or ``[...]`` for the soft
            values of maximum causal entropy, where the maximum over actions becomes
            ``temperature * logsumexp(values / temperature)``.
    """
    horizon = lane_rewards.shape[-2]
    like = {"dtype": lane_rewards.dtype, "device": lane_rewards.device}
    switch = torch.as_tensor(switch_reward, **like)[..., None]
    value = torch.zeros_like(lane_rewards[..., 0, :])
    stay_value = switch_value = value
    for step in range(horizon - 1, -1, -1):
        reached = lane_rewards[..., step, :] + discount * value
        stay_value, switch_value = reached, switch + reached.flip(-1)
        value = _maximum(stay_value, switch_value, temperature)
    both = torch.stack([stay_value, switch_value], -1)
    index = lane[..., None, None].expand(*lane.shape, 1, 2)
    return both.gather(-2, index).squeeze(-2)


def _maximum(first: Tensor, second: Tensor, temperature: Tensor | float | None) -> Tensor:
    if temperature is None:
        return torch.maximum(first, second)
    scale = torch.as_tensor(temperature, dtype=first.dtype, device=first.device)[..., None]
    return scale * torch.logaddexp(first / scale, second / scale)

"""An expert with full view: it tries out manoeuvres in the world itself and takes the best.

A short model-predictive controller. Candidates are pairs of a lane and a speed. For each of them a
simple controller drives the ego there in the true, batched physics for a few seconds; the first
action of the candidate with the largest return is taken, and everything is planned anew at the
next decision. The expert knows where all vehicles are and what they intend, and how others respond
to it; it does not know of manoeuvres that have not begun.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mirror_ppl.domains.base import map_state, total_reward
from mirror_ppl.domains.highway.road import (
    LANES,
    LENGTH,
    LIMIT,
    MAX_ACCELERATION,
    MAX_STEERING,
    centre_of,
    wrapped,
)
from mirror_ppl.domains.highway.state import NEVER, HighwayState, flat
from mirror_ppl.domains.highway.world import Highway

HEADING_GAIN, LATERAL_GAIN, SPEED_GAIN = 2.0, 0.7, 1.5
"""Gains of the controller, per second; softer than other vehicles', which steer at every tick."""
STEEPEST = 0.15
"""Radians to the road at which it changes lanes at most."""
SLOWEST = 1.0
"""m/s below which steering is as at this speed."""


@dataclass(frozen=True)
class ExpertOptions:
    """How far the expert plans, and what it considers.

    Attributes:
        horizon: decisions that it looks ahead.
        speeds: m/s, in shares of the speed limit, that it considers in each lane.
    """

    horizon: int = 20
    speeds: tuple[float, ...] = (0.0, 0.5, 0.8, 0.97)

    def __post_init__(self) -> None:
        if self.horizon < 1 or not self.speeds:
            raise ValueError("the expert needs a horizon of at least 1 and at least one speed")


def act(
    state: HighwayState, options: ExpertOptions | None = None, world: Highway | None = None
) -> Tensor:
    """Return the expert's actions ``[..., 2]`` in states ``[...]``."""
    options, world = options or ExpertOptions(), world or Highway()
    start, shape = flat(state)
    start = replace(start, cue_at=torch.where(start.begun == NEVER, NEVER, start.cue_at))
    speeds = start.x.new_tensor(options.speeds) * LIMIT
    lane = torch.arange(LANES, device=speeds.device).repeat_interleave(len(speeds))
    speed, many = speeds.repeat(LANES), len(lane)
    now = map_state(lambda part: part[:, None].expand(-1, many, *part.shape[1:]), start)
    total = first = None
    for _ in range(options.horizon):
        action = drive_to(now, lane, speed)
        following = world.transition(now, action)
        reward = total_reward(world.rewards(now, action, following))
        first = action if first is None else first
        total = reward if total is None else total + reward
        now = following
    assert total is not None and first is not None
    best = total.argmax(-1)
    chosen = first.gather(1, best[:, None, None].expand(-1, 1, 2))[:, 0]
    return chosen.reshape(*shape, 2)


def drive_to(state: HighwayState, lane: Tensor, speed: Tensor) -> Tensor:
    """Return actions ``[..., 2]`` of a controller that moves the ego to a lane and a speed.

    Args:
        state: ``[...]``.
        lane: index ``[...]``.
        speed: m/s ``[...]``.
    """
    y, heading, now = state.y[..., 0], state.heading[..., 0], state.speed[..., 0]
    fast = now.clamp(min=SLOWEST)
    course = torch.asin((LATERAL_GAIN * (centre_of(lane) - y) / fast).clamp(-1, 1))
    course = course.clamp(-STEEPEST, STEEPEST)
    turning = HEADING_GAIN * wrapped(course - heading)
    slip = torch.asin((LENGTH / 2 / fast * turning).clamp(-1, 1)).clamp(-math.pi / 4, math.pi / 4)
    steering = torch.atan(2 * torch.tan(slip)) / MAX_STEERING
    acceleration = SPEED_GAIN * (speed - now) / MAX_ACCELERATION
    return torch.stack([steering, acceleration], -1).clamp(-1, 1)

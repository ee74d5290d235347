"""What drivers decide: a lane to aim for and a speed, and the controls that follow from it.

People do not decide upon angles of a wheel five times a second. A decision is one of twelve
manoeuvres, the pairs of a lane and a speed, and a simple controller turns it into steering and
acceleration. Aiming for the lane and keeping the speed that one has is to go on as before; a change
of lanes that takes ten decisions can be given up at each of them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mirror_ppl.domains.highway.road import (
    LANES,
    LENGTH,
    LIMIT,
    MAX_ACCELERATION,
    MAX_STEERING,
    centre_of,
    wrapped,
)
from mirror_ppl.domains.highway.state import HighwayState

SPEEDS = (0.0, 0.5, 0.8, 0.97)
"""Speeds in shares of the limit; the fastest leaves room for errors, which the reward punishes."""
SPEED_NAMES = ("stop", "slow", "medium", "fast")
LANE_NAMES = ("left", "middle", "right")
MANOEUVRES = tuple(f"{lane} lane {speed}" for lane in LANE_NAMES for speed in SPEED_NAMES)
"""Lane and speed of each manoeuvre in words; the lane changes slowest."""
SPEED_WORDS = ("stop", "go slowly", "go at medium speed", "go fast")
REFLECTED = tuple(
    (LANES - 1 - lane) * len(SPEEDS) + speed
    for lane in range(LANES)
    for speed in range(len(SPEEDS))
)
"""Index of the mirror image of each manoeuvre."""

HEADING_GAIN, LATERAL_GAIN, SPEED_GAIN = 2.0, 0.7, 1.5
"""Gains of the controller, per second; softer than other vehicles', which steer at every tick."""
STEEPEST = 0.15
"""Radians to the road at which it changes lanes at most."""
SLOWEST = 1.0
"""m/s below which steering is as at this speed."""


def deed(action: int) -> str:
    """Return words for a manoeuvre that follow "they would"."""
    lane, speed = divmod(action, len(SPEEDS))
    return f"{SPEED_WORDS[speed]} in the {LANE_NAMES[lane]} lane"


def lanes_and_speeds(like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lane ``[A]`` and the speed ``[A]`` in m/s of each manoeuvre."""
    speeds = torch.tensor(SPEEDS, dtype=like.dtype, device=like.device) * LIMIT
    lanes = torch.arange(LANES, device=like.device).repeat_interleave(len(SPEEDS))
    return lanes, speeds.repeat(LANES)


def controls(state: HighwayState, action: Tensor) -> Tensor:
    """Return steering and acceleration ``[..., 2]`` in [-1, 1].

    Args:
        state: ``[...]``.
        action: manoeuvres ``[...]`` (whole numbers); or controls themselves ``[..., 2]`` (floats),
            which are cut to [-1, 1].
    """
    if action.is_floating_point():
        return action.clamp(-1, 1).to(state.x.dtype)
    lanes, speeds = lanes_and_speeds(state.x)
    return drive_to(state, lanes[action], speeds[action])


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

"""The road, its vehicles and the clock: sizes and limits that all parts of the world share.

Coordinates are highway-env's: ``x`` along the road, ``y`` across it to the right, angles clockwise
seen from above. The centre of lane ``k`` is at ``y = 4 k``; lane 0 is the leftmost.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LANES = 3
LANE_WIDTH = 4.0
"""In metres, as in highway-env."""
SHOULDER = 2.0
"""Width in metres of the shoulder on either side of the road; beyond it a round ends."""
LEFT_EDGE = -LANE_WIDTH / 2
RIGHT_EDGE = (LANES - 0.5) * LANE_WIDTH
"""``y`` of the lines between the outer lanes and the shoulders, in metres."""

LENGTH, WIDTH = 5.0, 2.0
"""Size of every vehicle in metres, as in highway-env."""
OTHERS = 8
"""Number of other vehicles. The ego is vehicle 0 of ``1 + OTHERS``."""

TICK = 0.05
"""Seconds of a step of the physics (20 Hz)."""
ROUND_TICKS = 480
"""Ticks of a round: 24 seconds."""
DECISION_TICKS = 10
"""Ticks of a manoeuvre: people decide twice a second."""
TICKS = 4
"""Ticks for which steering and acceleration are held: they are set five times a second."""

MAX_STEERING = 0.2
"""Radians of the front wheels at a steering action of 1: at 40 km/h half a g across the road."""
MAX_ACCELERATION = 5.0
"""m/s2 at an acceleration action of 1, and of braking at -1; highway-env's default."""
LIMIT = 40.0 / 3.6
"""The speed limit ``v_max`` of the supplement, 40 km/h, in m/s."""
EGO_SPEEDS = (0.0, 60.0 / 3.6)
"""Speeds in m/s between which the ego's acceleration is not opposed."""


def centre_of(lane: Tensor) -> Tensor:
    """Return ``y`` in metres of the centre of lanes ``[...]``."""
    return lane * LANE_WIDTH


def lane_of(y: Tensor) -> Tensor:
    """Return the index ``[...]`` of the lane with the nearest centre; the left one of two."""
    return torch.ceil((y - LANE_WIDTH / 2) / LANE_WIDTH).clamp(0, LANES - 1).long()


def wrapped(angle: Tensor) -> Tensor:
    """Return angles ``[...]`` in radians between -pi and pi."""
    return (angle + math.pi) % (2 * math.pi) - math.pi

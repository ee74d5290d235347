"""The four cars of driving, the scenarios that they play, and the state that they make up."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

CARS = ("front-left", "front-right", "rear-left", "rear-right")
"""The four cars, named by where they start."""
CAR_LANES = (0, 1, 0, 1)
CAR_SIDES = (1, 1, -1, -1)

# Relative speed of each car in cells per step, one row a scenario: a front car approaches when it
# slows down (-1), a rear car when it speeds up (+1).
SCENARIO_SPEEDS = {
    "front-left slows": (-1, +1, -1, -1),
    "front-right slows": (+1, -1, -1, -1),
    "both front cars slow": (-1, -1, -1, -1),
    "left lane squeezes": (-1, +1, +1, -1),
    "right lane squeezes": (+1, -1, -1, +1),
    "front-left slows, rear-right speeds up": (-1, +1, -1, +1),
    "front-right slows, rear-left speeds up": (+1, -1, +1, -1),
    "all four close in": (-1, -1, +1, +1),
}


@dataclass(frozen=True)
class DrivingState:
    """State of a batch of rounds.

    Attributes:
        lane: ego's lane ``[...]``, 0 left, 1 right.
        position: cells ahead of the ego ``[..., 4]``, negative behind, not saturated.
        speed: relative speed ``[..., 4]`` in cells per step.
    """

    lane: Tensor
    position: Tensor
    speed: Tensor

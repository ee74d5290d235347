"""The task reward of the supplement's CARLA domain (section E, equation 7), term by term.

Terms are of one decision: of the state before it, the action, and the state that it leads to.

================  =====================================================================
speed             ``v / v_max`` up to ``v_max`` = 40 km/h; above it ``-(v - v_max)``
brake             minus the square of the share of full braking, at first
steer             minus the square of the share of full steering, at first
lane_change       -1 for another lane than before
lane_centre       minus the distance to the centre of the lane, in half widths of a lane
front_proximity   -2 if the lidar's sector that faces ahead sees a car within 20 m
back_proximity    -2 likewise behind
near              -4 if any sector sees a car within 1.6 m
shoulder          -4 while the ego's body is over the line of the road
accident          -100 for hitting a car, or leaving the shoulder; both end the round
================  =====================================================================

Departures, and what the supplement leaves open
    - **Units of equation 7.** ``v_max`` is given in km/h and the second case is not normalized, so
      speeds above it count in km/h: 42 km/h gives -2.
    - **Braking and steering** have no coefficients there. Squares leave small corrections nearly
      free; full braking costs what full speed earns.
    - **Distances** are those of the lidar, from the ego's centre. So 1.6 m is 0.6 m from its sides,
      and ahead or behind it is reached only by a collision.
    - **Front and back facing beams** are the one sector of 10 degrees that faces there; a car in
      the next lane is never within 20 m in it while the ego drives along its lane.
    - **Shoulder**: entered when the side of the ego's body crosses the line.
    - **Accident** is not in the list. A round ends with it, and without a penalty an ego with cars
      close ahead and behind, at about -3 a decision, would soon gain by a collision.
    - A finished round earns nothing.
    - **Length of a decision.** Terms have the same size for decisions of 0.5 s (manoeuvres) and of
      0.2 s (controls). So terms that are earned at each decision count 2.5 times as much a second
      with controls; relative to them an accident and a change of lanes weigh 2.5 times less.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mirror_ppl.domains.highway.geometry import clearance
from mirror_ppl.domains.highway.lidar import AHEAD, BACK, SECTOR, nearest_in, seen_boxes
from mirror_ppl.domains.highway.road import (
    LANE_WIDTH,
    LEFT_EDGE,
    LIMIT,
    RIGHT_EDGE,
    WIDTH,
    centre_of,
)
from mirror_ppl.domains.highway.state import HighwayState

TERMS = (
    "speed",
    "brake",
    "steer",
    "lane_change",
    "lane_centre",
    "front_proximity",
    "back_proximity",
    "near",
    "shoulder",
    "accident",
)
KMH = 3.6
"""km/h in a m/s."""
LANE_CHANGE, PROXIMITY, NEAR, ROAD_SHOULDER, ACCIDENT = -1.0, -2.0, -4.0, -4.0, -100.0
PROXIMITY_RANGE, NEAR_RANGE = 20.0, 1.6
"""Metres."""


def rewards(state: HighwayState, action: Tensor, following: HighwayState) -> dict[str, Tensor]:
    """Return reward terms ``[...]`` by name, in units of reward.

    Args:
        state: ``[...]`` before the decision.
        action: steering and acceleration ``[..., 2]``.
        following: ``[...]`` after it.
    """
    steering, acceleration = action.clamp(-1, 1).unbind(-1)
    ahead, back, around = proximities(following)
    y = following.y[..., 0]
    dtype = following.x.dtype
    terms = {
        "speed": speed_reward(following.speed[..., 0]),
        "brake": -(acceleration.clamp(max=0) ** 2),
        "steer": -(steering**2),
        "lane_change": LANE_CHANGE * (following.lane[..., 0] != state.lane[..., 0]),
        "lane_centre": -(y - centre_of(following.lane[..., 0])).abs() / (LANE_WIDTH / 2),
        "front_proximity": PROXIMITY * (ahead <= PROXIMITY_RANGE),
        "back_proximity": PROXIMITY * (back <= PROXIMITY_RANGE),
        "near": NEAR * (around <= NEAR_RANGE),
        "shoulder": ROAD_SHOULDER * on_shoulder(following),
        "accident": ACCIDENT * following.over,
    }
    goes_on = ~state.over
    return {name: torch.where(goes_on, term.to(dtype), 0.0) for name, term in terms.items()}


def speed_reward(speed: Tensor) -> Tensor:
    """Return equation 7 of speeds ``[...]`` in m/s."""
    return torch.where(speed <= LIMIT, speed / LIMIT, -(speed - LIMIT) * KMH)


def proximities(state: HighwayState) -> tuple[Tensor, Tensor, Tensor]:
    """Return metres to the nearest car ahead, behind and anywhere, each ``[...]``.

    The first two are distances of the lidar's sectors, the last one the least of all sectors, but
    without its range; they are possibly infinite beyond its range, and where there is no car.
    """
    boxes = seen_boxes(state)
    middles = torch.tensor([AHEAD, BACK], dtype=boxes.dtype, device=boxes.device) * SECTOR
    ahead, back = nearest_in(boxes, middles)[0].unbind(-1)
    return ahead, back, clearance(boxes).amin(-1)


def on_shoulder(state: HighwayState) -> Tensor:
    """Return whether ``[...]`` a side of the ego's body is beyond a line of the road."""
    y = state.y[..., 0]
    return (y - WIDTH / 2 < LEFT_EDGE) | (y + WIDTH / 2 > RIGHT_EDGE)

"""Values that observations and actions of the highway can have."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation
from mirror_ppl.domains.highway.lidar import RANGE, SECTOR, SECTORS
from mirror_ppl.domains.highway.manoeuvres import MANOEUVRES
from mirror_ppl.domains.highway.road import (
    LANES,
    LEFT_EDGE,
    LENGTH,
    RIGHT_EDGE,
    SHOULDER,
    WIDTH,
    centre_of,
    lane_of,
)
from mirror_ppl.domains.highway.speech import AHEAD, NOTHING, SIDES
from mirror_ppl.errors import InputError, shown

FASTEST = 60.0
"""Bound of relative velocities, m/s."""
LIMITS: Mapping[str, tuple[list[float], list[float]]] = {
    "ego": (
        [0.0, -15.0, -math.pi, -1.0, -1.0, -1.0, 0.0],
        [LANES - 1.0, 15.0, math.pi, 20.0, 1.0, 1.0, 1.0],
    ),
    "visual": ([0.0, -FASTEST, -FASTEST], [RANGE, FASTEST, FASTEST]),
    "verbal": ([0.0], [float(NOTHING)]),
}
"""Least and largest value of each feature."""
AN_ACTION = (
    "an action of the highway is a tensor of manoeuvres (whole numbers), or of steering and "
    "acceleration: finite numbers [..., 2]"
)
ROUNDING = 1e-3
"""Tolerance of the limits."""
REACH = math.hypot(LENGTH, WIDTH) / 2
"""Metres from the centre of a car to its corners."""
SLOW = 2.0
"""m/s below which rounded velocities do not give the heading of a car."""
MARGIN = 0.15
"""Metres that positions of a car's centre may be off, as measurements are rounded."""


def outside(observation: Observation, names: Mapping[str, tuple[str, ...]]) -> dict[str, Tensor]:
    """Return by rule the observations ``[...]`` with a feature outside its limits.

    Args:
        observation: ``[..., E]`` and ``[..., K, F]``.
        names: of the features of each modality.
    """
    found = {}
    for modality, features in names.items():
        for place, (name, low, high) in enumerate(zip(features, *LIMITS[modality], strict=True)):
            value = observation[modality][..., place]
            wrong = (value < low - ROUNDING) | (value > high + ROUNDING)
            rule = f"{name} of {modality} has to be from {low:.4g} to {high:.4g}"
            found[rule] = wrong if modality == "ego" else wrong.any(-1)
    return found


def impossible(observation: Observation) -> dict[str, Tensor]:
    """Return by rule the observations ``[...]`` whose parts exclude each other.

    Args:
        observation: ``[..., E]`` and ``[..., K, F]``.
    """
    distance = observation["visual"][..., 0]
    moves = (observation["visual"][..., 1:].abs() > ROUNDING).any(-1)
    _, y = _points(observation)
    # A car within half a RESOLUTION of the range is measured at the range, with its velocity; that
    # is possible only where the sector is on the road there.
    on_road = (y[0] <= RIGHT_EDGE + SHOULDER + REACH) & (y[1] >= LEFT_EDGE - SHOULDER - REACH)
    return {
        f"a sector with nothing within {RANGE:g} m has to have the velocity 0": (
            (distance >= RANGE - ROUNDING) & moves & ~on_road
        ).any(-1),
        "a direction in which the lidar sees a car must not have the sentence that nothing is "
        "there": _denied(observation).any(-1),
    }


def _denied(observation: Observation) -> Tensor:
    """Return sectors ``[..., 36]`` with a car that must be in a direction said to be empty.

    Directions are those of centres of cars, of which a sector shows one point. Only cars count
    whose centre, wherever it may be, is in directions of which all are said to be empty.
    """
    distance, along, across = observation["visual"].unbind(-1)
    lane, _, heading, speed = (part[..., None] for part in observation["ego"][..., :4].unbind(-1))
    x, y = _points(observation)
    # Cars move where they head, so that velocities give their heading but for slow ones.
    forward = along + speed
    turned = torch.atan2(across, forward) + heading
    cos, sin = torch.cos(turned).abs(), torch.sin(turned).abs()
    slow = torch.hypot(forward, across) < SLOW
    length = torch.where(slow, REACH, (LENGTH * cos + WIDTH * sin) / 2) + MARGIN
    width = torch.where(slow, REACH, (LENGTH * sin + WIDTH * cos) / 2) + MARGIN
    first, last = lane_of(y[0] - width) - lane, lane_of(y[1] + width) - lane
    ahead, behind = x[0] - length > 0, x[1] + length < 0
    known = (distance < RANGE) & (ahead | behind) & (first >= -1) & (last <= 1)
    known = known & (x[0] - length > -RANGE) & (x[1] + length < RANGE)
    denied = known
    for place, (side, front) in enumerate(zip(SIDES, AHEAD, strict=True)):
        possible = (first <= side) & (side <= last) & (ahead if front else behind)
        said = observation["verbal"][..., place, 0] == NOTHING
        denied = denied & (said[..., None] | ~possible)
    return denied


def _points(observation: Observation) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Return the least and largest x and y ``[..., 36]`` of each sector's nearest point.

    In metres, x ahead of the ego along the road and y across the road.
    """
    lane, offset, heading = (part[..., None] for part in observation["ego"][..., :3].unbind(-1))
    distance = observation["visual"][..., 0]
    middle = torch.arange(SECTORS, dtype=distance.dtype, device=distance.device) * SECTOR + heading
    sides = [middle - SECTOR / 2, middle, middle + SECTOR / 2]
    x = torch.stack([distance * torch.cos(side) for side in sides])
    y = torch.stack([distance * torch.sin(side) for side in sides]) + centre_of(lane) + offset
    # Between these angles a sine is at most 0.1% larger than at them, which MARGIN covers.
    return (x.amin(0), x.amax(0)), (y.amin(0), y.amax(0))


def require_action(action: Tensor) -> Tensor:
    """Return manoeuvres ``[...]``, or steering and acceleration ``[..., 2]``.

    Raises:
        InputError: there is no such manoeuvre, or the controls are of another shape or not finite.
    """
    if not isinstance(action, Tensor) or action.is_complex() or action.dtype is torch.bool:
        raise InputError(f"{AN_ACTION}, not {shown(action)}")
    if action.is_floating_point():
        if action.shape[-1:] != (2,) or not bool(action.isfinite().all()):
            raise InputError(f"{AN_ACTION}, not {shown(action.tolist())}")
        return action
    if action.numel() and not bool(((action >= 0) & (action < len(MANOEUVRES))).all()):
        most = len(MANOEUVRES) - 1
        raise InputError(
            f"manoeuvres of the highway count from 0 to {most}, not {shown(action.tolist())}"
        )
    return action.long()

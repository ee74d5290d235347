"""Values that observations and actions of the highway can have."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation
from mirror_ppl.domains.highway.lidar import RANGE
from mirror_ppl.domains.highway.manoeuvres import MANOEUVRES
from mirror_ppl.domains.highway.road import LANES
from mirror_ppl.domains.highway.speech import NOTHING
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

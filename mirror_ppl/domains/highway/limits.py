"""Values that observations and actions of the highway can have."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torch import Tensor

from mirror_ppl.domains.base import Observation
from mirror_ppl.domains.highway.lidar import RANGE
from mirror_ppl.domains.highway.manoeuvres import MANOEUVRES
from mirror_ppl.domains.highway.road import LANES
from mirror_ppl.domains.highway.speech import NOTHING
from mirror_ppl.errors import InputError

FASTEST = 60.0
"""m/s that relative velocities never reach."""
LIMITS: Mapping[str, tuple[list[float], list[float]]] = {
    "ego": (
        [0.0, -10.0, -math.pi, -1.0, -1.0, -1.0, 0.0],
        [LANES - 1.0, 10.0, math.pi, 20.0, 1.0, 1.0, 1.0],
    ),
    "visual": ([0.0, -FASTEST, -FASTEST], [RANGE, FASTEST, FASTEST]),
    "verbal": ([0.0], [float(NOTHING)]),
}
"""Least and largest value of each feature."""
ROUNDING = 1e-3
"""By which values may lie outside."""


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
    if action.is_floating_point():
        if action.shape[-1:] != (2,) or not bool(action.isfinite().all()):
            raise InputError(
                "an action of the highway is a manoeuvre (a whole number), or steering and "
                f"acceleration: finite numbers [..., 2], not {_shown(action)}"
            )
    elif action.numel() and not bool(((action >= 0) & (action < len(MANOEUVRES))).all()):
        raise InputError(
            f"manoeuvres of the highway count from 0 to {len(MANOEUVRES) - 1}, not {_shown(action)}"
        )
    return action


def _shown(action: Tensor) -> str:
    few = action.numel() <= 4  # noqa: PLR2004
    return str(action.tolist()) if few else f"numbers {list(action.shape)}"

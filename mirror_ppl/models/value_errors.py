"""Small differences to the best action's value, which may be errors of the robot's network."""

from __future__ import annotations

import torch
from torch import Tensor

from mirror_ppl.models.self_model import SelfModel

NEGLIGIBLE = 1e-6
"""Size of errors below which values stay as they are."""


def choice_values(self_model: SelfModel, belief: Tensor) -> Tensor:
    """Values ``[..., A]`` by which people choose at beliefs ``[..., Z]``.

    They are the robot's, beyond errors of the size in the world's record.
    """
    return beyond_errors(self_model.action_values(belief), self_model.domain.record.value_error)


def beyond_errors(values: Tensor, error: float) -> Tensor:
    """Shrink differences to the best action's value, the more the smaller they are.

    With ``d = max Q - Q``, values become ``max Q - d (1 - exp(-(d / error)^2))``. Actions that are
    all the best, whose values the network separates by its errors, are nearly equal again, so that
    consistency does not multiply the errors, and choices among such actions are no evidence. A
    third of a difference as large as the error is lost, and 2% of one that is twice as large.
    Differences between two actions that are both more than .7 errors behind the best are not made
    smaller.

    Args:
        values: action values ``[..., A]``, in units of reward.
        error: size of the errors; 0 leaves the values as they are.
    """
    if error < NEGLIGIBLE:
        return values
    best = values.amax(-1, keepdim=True)
    behind = best - values
    return best - behind * -torch.expm1(-((behind / error) ** 2))

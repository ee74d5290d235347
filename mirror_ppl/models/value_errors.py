"""Differences of action values that may be errors of the robot's network."""

from __future__ import annotations

import torch
from torch import Tensor


def beyond_errors(values: Tensor, error: float) -> Tensor:
    """Shrink differences to the best action's value, the more the smaller they are.

    With ``A = max Q - Q``, values become ``max Q - A (1 - exp(-(A / error)^2))``. Equally good
    actions, whose values the network separates by its errors, are nearly equal again, so that
    consistency does not multiply the errors, and choices among such actions are no evidence. A
    third of a difference as large as the error is lost, and 2% of one that is twice as large.

    Args:
        values: action values ``[..., A]``, in units of reward.
        error: size of the errors; 0 leaves the values as they are.
    """
    if not error:
        return values
    best = values.amax(-1, keepdim=True)
    behind = best - values
    return best - behind * -torch.expm1(-((behind / error) ** 2))

"""Continuous actions: controls within bounds, such as steering, and the grid that stands for them.

The robot values, and people intend, one of a grid of control values: the world's actions. What a
person executes is continuous. It is recorded as it is, and counts as the action nearest to it.
Without a grid, action values could not be computed for all actions at once, and sums over what
people may have intended would be integrals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from numbers import Integral
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mirror_ppl.errors import DomainError, InputError, shown

SLACK = 1e-3
"""Distance from the bounds, in levels, by which values may be outside, as numbers are rounded."""
SQRT_HALF = 0.5**0.5


@dataclass(frozen=True)
class Control:
    """A number that people set in each step.

    Attributes:
        name: such as ``steering``.
        low: least value.
        high: largest value.
        levels: number of values of it in the grid, at equal distances from ``low`` to ``high``.
        unit: such as ``m/s``.

    Raises:
        DomainError: there are fewer than two levels, or the bounds are not in order.
    """

    name: str
    low: float = -1.0
    high: float = 1.0
    levels: int = 3
    unit: str = ""

    def __post_init__(self) -> None:
        if not (isinstance(self.levels, Integral) and self.levels > 1):
            raise DomainError(f"{self.name}: expected 2 or more levels, found {self.levels!r}")
        if not self.low < self.high < float("inf") or self.low == -float("inf"):
            raise DomainError(
                f"{self.name}: expected finite bounds, the low one below the high one, found "
                f"{self.low} and {self.high}"
            )

    @property
    def spacing(self) -> float:
        """Distance between levels."""
        return (self.high - self.low) / (self.levels - 1)

    @property
    def values(self) -> Tensor:
        """Levels ``[levels]``."""
        return torch.linspace(self.low, self.high, self.levels)


def action_names(controls: Sequence[Control]) -> tuple[str, ...]:
    """Return names of the actions, such as ``steering -1 and speed 2 m/s``."""
    each = [
        [
            f"{one.name} {round(one.low + level * one.spacing, 9) + 0.0:.7g} {one.unit}".strip()
            for level in range(one.levels)
        ]
        for one in controls
    ]
    return tuple(" and ".join(names) for names in product(*each))


def grid(controls: Sequence[Control]) -> Tensor:
    """Return the control values that the actions stand for, ``[A, C]`` of C controls."""
    return torch.cartesian_prod(*(one.values for one in controls)).view(-1, len(controls))


def nearest_action(controls: Sequence[Control], values: Tensor) -> Tensor:
    """Return the action ``[...]`` nearest to control values ``[..., C]``; half way, the higher.

    Values are rounded as recordings are, to torch's default dtype, so that all agree on borders.
    """
    number = torch.zeros(values.shape[:-1], dtype=torch.long, device=values.device)
    values = values.to(torch.get_default_dtype()).double()
    for place, one in enumerate(controls):
        level = torch.floor((values[..., place] - one.low) / one.spacing + 0.5).long()
        number = number * one.levels + level.clamp(0, one.levels - 1)
    return number


def within_bounds(controls: Sequence[Control], values: Tensor) -> Tensor:
    """Return where values ``[..., C]`` are within the bounds, to a thousandth of a level."""
    low, high, slack = (
        values.new_tensor([own(one) for one in controls])
        for own in (lambda c: c.low, lambda c: c.high, lambda c: SLACK * c.spacing)
    )
    return (values >= low - slack) & (values <= high + slack)


def bounds_in_words(controls: Sequence[Control]) -> str:
    """Return the bounds for a message, such as ``steering -1 to 1, speed 0 to 2``."""
    return ", ".join(f"{one.name} {one.low:g} to {one.high:g}" for one in controls)


def action_at(controls: Sequence[Control], given: Any) -> int:
    """Return the action nearest to what one person executed: C numbers within the bounds.

    Raises:
        InputError: it is something else.
    """
    try:
        values = torch.from_numpy(np.asarray(given, float))
    except (TypeError, ValueError):
        values = torch.empty(0)
    expected = f"expected an action of shape ({len(controls)},), {bounds_in_words(controls)}"
    own = given if not hasattr(given, "tolist") else given.tolist()
    if values.shape != (len(controls),):
        raise InputError(f"{expected}; found {shown(own)}")
    if not bool(within_bounds(controls, values).all()):
        raise InputError(f"{expected}; {shown(own)} is out of bounds")
    return int(nearest_action(controls, values))


def execution(controls: Sequence[Control], noise: Tensor) -> Tensor:
    """Return the probability ``[..., A, A]`` of executing each action, given the intended one.

    Each control is set with independent Gaussian noise, in units of the distance between its
    levels, and stays within its bounds. The probability is that of being nearest to each level.

    Args:
        controls: of the world.
        noise: standard deviation ``[...]``, above 0.
    """
    total = noise.new_ones(*noise.shape, 1, 1)
    for one in controls:
        level = torch.arange(one.levels, dtype=noise.dtype, device=noise.device)
        edges = level[1:] - 0.5 - level[:, None]  # [intended, edge]
        # ndtr has no tail with 32 bits.
        below = 0.5 * torch.erfc(-edges / noise[..., None, None] * SQRT_HALF)
        zero, all_ = below.new_zeros(*below.shape[:-1], 1), below.new_ones(*below.shape[:-1], 1)
        own = torch.cat([below, all_], -1) - torch.cat([zero, below], -1)
        both = total[..., :, None, :, None] * own[..., None, :, None, :]
        total = both.flatten(-4, -3).flatten(-2)
    return total

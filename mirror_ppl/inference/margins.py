"""The map from standard normal numbers to a prior's margins, as a guide reads and proposes them.

Some sites of a prior have long tails in unconstrained space: the logit of the probability of
noticing a terminal is sometimes -40. No mixture of a few Gaussians is near such a prior. Each of
its margins is a standard normal number, mapped piecewise linearly between quantiles of draws.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import Normal, Transform, constraints

KNOTS = 33
REACH = 3.0
LEAST_GAP = 1e-3


def normal_knots() -> Tensor:
    """The standard normal numbers at which a stretch changes its slope, ``[K]``."""
    return torch.linspace(-REACH, REACH, KNOTS)


def prior_knots(places: Tensor) -> Tensor:
    """Where they go: quantiles ``[D, K]`` of draws ``[S, D]`` from the prior."""
    standard = Normal(torch.zeros(()), torch.ones(()))
    knots = places.quantile(standard.cdf(normal_knots()).to(places), dim=0).T
    # What many draws have in common is no step: every knot lies above the one before it.
    gaps = knots.diff(dim=-1).clamp(min=LEAST_GAP)
    return torch.cat([knots[:, :1], knots[:, :1] + gaps.cumsum(-1)], -1)


class PriorMargins(Transform):
    """From ``[..., D]`` standard normal numbers to places in unconstrained space.

    Args:
        knots: of each dimension, increasing, ``[D, K]``. The first and last slopes go on beyond
            them.
    """

    bijective = True
    domain = constraints.independent(constraints.real, 1)
    codomain = constraints.independent(constraints.real, 1)

    def __init__(self, knots: Tensor) -> None:
        super().__init__(cache_size=1)
        self.knots = knots
        self.normal = normal_knots().to(knots).expand_as(knots).contiguous()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PriorMargins) and torch.equal(self.knots, other.knots)

    __hash__ = Transform.__hash__

    @property
    def sign(self) -> int:
        """Of the slope."""
        return 1

    def _call(self, x: Tensor) -> Tensor:
        return _interpolated(x, self.normal, self.knots)[0]

    def _inverse(self, y: Tensor) -> Tensor:
        return _interpolated(y, self.knots, self.normal)[0]

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        """Log of the stretch ``[...]`` of all dimensions together."""
        return _interpolated(x, self.normal, self.knots)[1].log().sum(-1)


def _interpolated(place: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Where ``[..., D]`` go, from knots to knots ``[D, K]``, and the slopes there."""
    size = place.shape[-1]
    flat = place.reshape(-1, size).T.contiguous()
    after = torch.searchsorted(start, flat).clamp(1, start.shape[-1] - 1)
    low, origin = start.gather(1, after - 1), end.gather(1, after - 1)
    slope = (end.gather(1, after) - origin) / (start.gather(1, after) - low)
    found = origin + (flat - low) * slope
    return found.T.view(place.shape), slope.T.view(place.shape)

"""Transform from standard normal variables to a prior, for the amortized guide.

Some sites of a prior have long tails in unconstrained space: the logit of the probability of
noticing a terminal is sometimes -40. No mixture of a few Gaussians approximates such a prior. Each
margin is therefore a standard normal variable ``y_d``, mapped piecewise linearly between quantiles
of prior draws. Dependence of sites on earlier ones, such as of probabilities on their common mean,
is removed, too::

    y_d = m_d(y_<d) + s_d(y_<d) u_d        m_d and log s_d quadratic, u_d about standard normal

so that an untrained guide approximates the prior.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.distributions import Normal, Transform, constraints

KNOTS = 33
REACH = 3.0
LEAST_GAP = 1e-3
RIDGE = 1e-7
LEAST_SCALE = 1e-2
MOST_LOG_SCALE = 4.0


def normal_knots() -> Tensor:
    """Knots of the piecewise linear maps in standard normal space, ``[K]``."""
    return torch.linspace(-REACH, REACH, KNOTS)


def prior_knots(places: Tensor) -> Tensor:
    """Images of the knots: quantiles ``[D, K]`` of draws ``[S, D]`` from the prior."""
    standard = Normal(torch.zeros(()), torch.ones(()))
    knots = places.quantile(standard.cdf(normal_knots()).to(places), dim=0).T
    # Ties among draws give no flat pieces: every knot lies above the one before it.
    gaps = knots.diff(dim=-1).clamp(min=LEAST_GAP)
    return torch.cat([knots[:, :1], knots[:, :1] + gaps.cumsum(-1)], -1)


class PriorMargins(Transform):
    """Transform from standard normal to unconstrained space, ``[..., D]``, for each margin.

    Args:
        knots: knots of each dimension, increasing, ``[D, K]``. Beyond them the first and last
            slopes continue.
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
        """Sign of the slope."""
        return 1

    def _call(self, x: Tensor) -> Tensor:
        return _interpolated(x, self.normal.to(x.device), self.knots.to(x.device))[0]

    def _inverse(self, y: Tensor) -> Tensor:
        return _interpolated(y, self.knots.to(y.device), self.normal.to(y.device))[0]

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        """Log of the stretch ``[...]`` of all dimensions together."""
        return _interpolated(x, self.normal, self.knots)[1].log().sum(-1)


class PriorDependence(Transform):
    """Transform from independent variables u to dependent ones y, ``[..., D]``, as in the prior.

    Args:
        mean: coefficients of m ``[D, F]``, see :func:`prior_dependence`.
        log_scale: coefficients of log s ``[D, F]``.
    """

    bijective = True
    domain = constraints.independent(constraints.real, 1)
    codomain = constraints.independent(constraints.real, 1)

    def __init__(self, mean: Tensor, log_scale: Tensor) -> None:
        super().__init__(cache_size=1)
        self.mean, self.log_scale = mean, log_scale

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PriorDependence) and all(
            torch.equal(own, its)
            for own, its in ((self.mean, other.mean), (self.log_scale, other.log_scale))
        )

    __hash__ = Transform.__hash__

    def _conditionals(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Means m and log scales ``[..., D]``; those of each d depend on earlier y only."""
        terms, mean, scale = _quadratic(y), self.mean.to(y.device), self.log_scale.to(y.device)
        limit = MOST_LOG_SCALE
        return terms @ mean.T, (terms @ scale.T).clamp(-limit, limit)

    def _call(self, x: Tensor) -> Tensor:
        y = torch.zeros_like(x)
        for place in range(x.shape[-1]):
            mean, log_scale = (part[..., place] for part in self._conditionals(y))
            own = mean + log_scale.exp() * x[..., place]
            y = torch.cat([y[..., :place], own[..., None], y[..., place + 1 :]], -1)
        return y

    def _inverse(self, y: Tensor) -> Tensor:
        mean, log_scale = self._conditionals(y)
        return (y - mean) * (-log_scale).exp()

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        """Log of the stretch ``[...]`` of all dimensions together."""
        del x
        return self._conditionals(y)[1].sum(-1)


def prior_dependence(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Fit coefficients ``[D, F]`` of means and log scales to draws ``[S, D]`` with normal margins.

    Each dimension is regressed on the earlier ones by least squares.
    """
    terms = _quadratic(normal)
    order = _quadratic(torch.arange(1.0, normal.shape[-1] + 1), torch.maximum)
    mean, log_scale = torch.zeros(2, normal.shape[-1], terms.shape[-1])
    for place in range(1, normal.shape[-1]):
        before = order <= place
        some = terms[:, before]
        ridge = RIDGE * len(normal) * torch.eye(some.shape[1])

        def fitted(values: Tensor, some: Tensor = some, ridge: Tensor = ridge) -> Tensor:
            return torch.linalg.solve(some.T @ some + ridge, some.T @ values)

        mean[place, before] = fitted(normal[:, place])
        left = normal[:, place] - some @ mean[place, before]
        log_scale[place, before] = fitted((left.abs() + LEAST_SCALE).log())
        # The regression of logarithms gives the scale up to a factor.
        log_scale[place, 0] += (left / (some @ log_scale[place, before]).exp()).std().log()
    return mean, log_scale


def independent(dimensions: int) -> tuple[Tensor, Tensor]:
    """Coefficients ``[D, F]`` without dependence."""
    terms = len(_quadratic(torch.zeros(dimensions)))
    return torch.zeros(dimensions, terms), torch.zeros(dimensions, terms)


def _quadratic(y: Tensor, product: Callable[[Tensor, Tensor], Tensor] = torch.mul) -> Tensor:
    """Quadratic features ``[..., F]`` (1, y, products) of clamped variables ``[..., D]``."""
    size = y.shape[-1]
    rows, columns = torch.triu_indices(size, size)
    if product is torch.mul:
        y = y.clamp(-REACH, REACH)
    products = product(y[..., rows], y[..., columns])
    return torch.cat([torch.ones_like(y[..., :1]), y, products], -1)


def _interpolated(place: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Interpolate ``[..., D]`` linearly from knots to knots ``[D, K]``; returns slopes, too."""
    size = place.shape[-1]
    flat = place.reshape(-1, size).T.contiguous()
    after = torch.searchsorted(start, flat).clamp(1, start.shape[-1] - 1)
    low, origin = start.gather(1, after - 1), end.gather(1, after - 1)
    slope = (end.gather(1, after) - origin) / (start.gather(1, after) - low)
    found = origin + (flat - low) * slope
    return found.T.view(place.shape), slope.T.view(place.shape)

"""A variant of the human model of drivers: how far they see is a smooth function of the angle."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility, by_eye
from mirror_ppl.domains.highway.lidar import SECTORS
from mirror_ppl.domains.highway.world import KNOTS
from mirror_ppl.models import implants as implant_priors
from mirror_ppl.models.human import HumanModel, Implants

LOG_REACH = "log_reach"
"""Site of the logarithm of the reach of sight in metres in each of the 36 sectors."""
MEDIAN = 20.0
"""Prior median of the reach in metres."""
LEVEL, SHAPE = 0.7, 0.9
"""Prior SD of the mean of the logarithm over angles, and of what differs between angles."""
WIDTH = math.radians(45)
"""Length scale of the differences, in radians."""
JITTER = 1e-4
"""Variance that is independent between sectors."""


class ByAngle(HumanModel):
    """Sees differently far in each of the 36 sectors, equally far in similar directions.

    The prior of the logarithm of the reach is a Gaussian process on the circle, with a periodic
    kernel (MacKay, *Introduction to Gaussian processes*, 1998)::

        log_reach   ~ Normal(log 20, K)           metres, in the 36 sectors
        K(a, b)     = 0.7² + 0.9² exp(-2 sin²((a - b) / 2) / w²)         w = 45 degrees
        reach_k     = exp(log_reach_k), rounded down to 0, 5, 10, 15, 20, 30, 45 or 60 metres
        n_t,k       = distance_t,k <= reach_k
    """

    def prior(self) -> dict[str, Tensor]:
        """Sample the reach, the assumption and the policy implants."""
        domain, like = self.domain, next(self.self_model.parameters())
        scale = _factor().to(like)
        mean = torch.full((SECTORS,), math.log(MEDIAN)).to(like)
        return (
            {LOG_REACH: pyro.sample(LOG_REACH, dist.MultivariateNormal(mean, scale_tril=scale))}
            | implant_priors.assumption_implants(domain, like)
            | implant_priors.policy_implants(domain, self.self_model.latent, like)
        )

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Return what is within the reach of its sector; a reach of 60 m is everything."""
        del step
        _, distance = self.domain.distance(observation)
        return by_eye(self.domain, distance <= reach_in_bins(implants[LOG_REACH]))


def reach_in_bins(log_reach: Tensor) -> Tensor:
    """Reach of sight in metres, rounded down to the world's ``reach_bins``."""
    bins = torch.tensor(KNOTS, dtype=log_reach.dtype, device=log_reach.device)
    return bins[torch.bucketize(log_reach.exp(), bins, right=True) - 1]


def _factor() -> Tensor:
    """Cholesky factor of the kernel ``[36, 36]``."""
    angle = torch.arange(SECTORS, dtype=torch.double) * 2 * math.pi / SECTORS
    near = torch.exp(-2 * torch.sin((angle - angle[:, None]) / 2).square() / WIDTH**2)
    return torch.linalg.cholesky(LEVEL**2 + SHAPE**2 * near + JITTER * torch.eye(SECTORS))


HUMAN_MODELS: dict[str, type[HumanModel]] = {"by-angle": ByAngle}
"""Human models of this world besides those of :mod:`mirror_ppl.models.variants`."""

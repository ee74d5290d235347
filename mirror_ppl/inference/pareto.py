"""Pareto-smoothed importance weights (Vehtari, Simpson, Gelman, Yao and Gabry, JMLR 2024).

ArviZ has them, too, but takes seconds to import, in each process that infers people.
"""

from __future__ import annotations

import math

import torch
from pyro.ops.stats import fit_generalized_pareto
from torch import Tensor

FEWEST = 4
"""Largest number of tail weights that is too few to fit a distribution."""


def pareto_smoothed(log_weights: Tensor) -> tuple[Tensor, float]:
    """Normalized log weights ``[S]`` with a smoothed tail, and its Pareto k.

    The largest weights are replaced by the expected order statistics of the generalized Pareto
    distribution that fits them; none exceeds the largest one. They are unreliable for k > 0.7. k is
    infinite if the tail is too short, and minus infinity if all weights, or the largest ones, are
    equal.

    Args:
        log_weights: in double precision, not normalized; not all minus infinity.
    """
    weights = log_weights - log_weights.max()
    if float(weights.min()) > -1e-9:
        return torch.log_softmax(weights, 0), -math.inf
    number = len(weights)
    ordered, order = weights.sort()
    most = math.ceil(min(number / 5, 3 * math.sqrt(number)))
    if most > FEWEST and float(ordered[-most]) > -1e-9:  # bounded, and no tail to fit
        return torch.log_softmax(weights, 0), -math.inf
    least = max(float(ordered[max(-most - 1, -number)]), math.log(torch.finfo(weights.dtype).tiny))
    tail = order[ordered > least]
    if len(tail) <= FEWEST:
        return torch.log_softmax(weights, 0), math.inf
    above = weights[tail].exp() - math.exp(least)
    if float(above.min()) > (1 - 1e-9) * float(above.max()):  # bounded, and no distribution to fit
        return torch.log_softmax(weights, 0), -math.inf
    k, scale = fit_generalized_pareto(above.cpu())
    if math.isfinite(k):
        share = (torch.arange(len(tail)).to(weights) + 0.5) / len(tail)
        excess = (
            -torch.log1p(-share)
            if abs(k) < torch.finfo(weights.dtype).eps
            else (torch.expm1(-k * torch.log1p(-share)) / k)
        )
        smoothed = torch.log(scale * excess + math.exp(least)).clamp(max=0.0)
        weights = weights.index_put((tail,), smoothed)
    return torch.log_softmax(weights, 0), k

"""Priors that are at odds with most people's posteriors.

A prior that makes most people improbable costs little after many rounds and much after few: what
they do is first taken for a lapse, or for not seeing (Evans and Moshonov, *Checking for prior-data
conflict*, 2006).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

PROBABILITY = 0.99
"""Probability of the central interval of the prior."""
DIMENSIONS = 3
"""Dimensions of draws of sites with one number per person, ``[S, P, 1]``."""
SHARE = 0.5
"""Share of the people beyond the interval, from which on a prior is at odds with them."""


def prior_conflicts(
    draws: Mapping[str, Tensor], prior: Mapping[str, Tensor]
) -> dict[str, dict[str, Any]]:
    """Return the priors outside whose 99% interval the posterior medians of most people lie.

    Posterior medians of people who come from the prior lie outside about as often as its draws at
    most: 1% of the time for one person, and for half of ten people once in 40 million fits.

    Args:
        draws: posterior draws ``[S, P, 1, ...]`` by site; only continuous sites with one number
            per person are compared.
        prior: prior draws ``[S', P, 1, ...]``.

    Returns:
        By site: ``people``, how many lie outside; ``median`` of their medians; and ``prior``, the
        limits of the interval.
    """
    found = {}
    for site, value in draws.items():
        if site not in prior or value.dim() != DIMENSIONS or not value.is_floating_point():
            continue
        medians, own = value.median(0).values.flatten(), prior[site].flatten()
        if not (medians.isfinite().all() and own.isfinite().all()):
            continue  # of another human model
        tail = (1 - PROBABILITY) / 2
        low, high = np.quantile(own.numpy(), [tail, 1 - tail])
        outside = (medians < low) | (medians > high)
        if bool(outside.any()) and float(outside.double().mean()) >= SHARE:
            found[site] = {
                "people": int(outside.sum()),
                "median": float(medians[outside].median()),
                "prior": [float(low), float(high)],
            }
    return found


def conflict_line(site: str, conflict: Mapping[str, Any], people: int) -> str:
    """Describe a prior that is at odds with most of the people."""
    low, high = conflict["prior"]
    return (
        f"The prior of {site} is at odds with {conflict['people']} of {people} people (99% "
        f"interval {low:.3g} to {high:.3g}, their median {conflict['median']:.3g})"
    )

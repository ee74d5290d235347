"""Priors that are at odds with what people's posteriors say.

Such a prior pulls posteriors towards it, little after many rounds and much after few (Evans and
Moshonov, *Checking for prior-data conflict*, 2006).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from mirror_ppl.arviz import az
from mirror_ppl.likelihood.densities import adds_to_prior
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import draw_prior, scalar_sites

PROBABILITY = 0.99
"""Probability of the shortest interval of the prior."""
DRAWS = 4000
"""Prior draws from which the interval is estimated: 40 of them are outside."""
SHARE = 0.5
"""If more than this share of the people are on one side of the interval, a prior is at odds."""
LEAST = 2
"""Least number of them: a single person may be unusual."""


def prior_conflicts(
    human: HumanModel, draws: Mapping[str, Tensor], rounds: Tensor, seed: int
) -> dict[str, dict[str, Any]]:
    """Return priors beyond whose shortest 99% interval most people lie, and at least two.

    A person lies beyond an end if the posterior median does. Of a person from the prior that has a
    probability of at most 2%, as half of the posterior is then in 1% of the prior; of six of ten
    independent people about one in a hundred million, for each site. An end where the prior has no
    tail, as at 0 if it is densest there, is none to lie beyond.

    Args:
        human: the human model. None of its priors are compared if it has factors or observed
            sites besides them.
        draws: posterior draws ``[S, P, 1, ...]`` by site; continuous sites with one number per
            person are compared.
        rounds: number of rounds of each person ``[P]``; those without any are left out.
        seed: of the prior's draws.

    Returns:
        By site: ``people``, how many lie beyond the interval, of how many (``of``); the ``median``
        of their posterior medians; and ``prior``, the ends of the interval.
    """
    acted = (rounds > 0).cpu().numpy()
    if not acted.any() or adds_to_prior(human):
        return {}
    prior, found = draw_prior(human, 1, DRAWS, seed), {}
    for site in scalar_sites(human):
        if site not in draws or draws[site].shape[1] != len(acted):
            continue  # of the world, not of people
        own = draws[site].cpu().numpy().reshape(-1, len(acted))
        medians = np.median(own, 0)[acted]
        values = prior[site].cpu().numpy().ravel()
        low, high = az.hdi(values, hdi_prob=PROBABILITY)
        below = medians[medians < low] if low > values.min() else medians[:0]
        above = medians[medians > high] if high < values.max() else medians[:0]
        beyond = max(below, above, key=len)
        if len(beyond) >= LEAST and len(beyond) > SHARE * len(medians):
            found[site] = {
                "people": len(beyond),
                "of": len(medians),
                "median": float(np.median(beyond)),
                "prior": [float(low), float(high)],
            }
    return found


def conflict_line(site: str, conflict: Mapping[str, Any]) -> str:
    """Describe a prior that is at odds with people, in a line."""
    low, high = conflict["prior"]
    return (
        f"The prior of {site} is at odds with {conflict['people']} of {conflict['of']} people: 99% "
        f"of it is from {low:.3g} to {high:.3g}, and their posterior medians are about "
        f"{conflict['median']:.3g}. Posteriors are pulled towards it, most of all after few "
        'rounds: fit with another prior (docs/trust.md, "Prior and data")'
    )

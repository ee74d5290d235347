"""Implants and a round of driving that the human model is tried with."""

import torch

from mirror_ppl.domains import get_domain
from mirror_ppl.models.implants import RESIDUAL_HIDDEN, assumption_sites, sight_sites

DRIVING = get_domain("driving")
SIGHTS, ASSUMED = sight_sites(DRIVING), assumption_sites(DRIVING)
STEPS, LATENT, ACTIONS = 15, 48, 2


def policy(human, people=1):
    """Implants of the policy at the median of the prior."""
    zeros = torch.zeros(people, 1, LATENT + 1, RESIDUAL_HIDDEN)
    return {
        "consistency": torch.full((people, 1), 3.0),
        "lapse": torch.full((people, 1), 0.02),
        "residual_in": zeros,
        "residual_out": torch.zeros(people, 1, RESIDUAL_HIDDEN + 1, ACTIONS),
    }


def nothing_told(steps):
    return {name: torch.zeros(1, steps, 4, dtype=torch.bool) for name in ("visual", "verbal")}


def sight(clear=0, closing=0, **bins):
    """Perceptual implants ``[1]``: bins by direction, 0 where not given."""
    values = {site: bins.get(site.removeprefix("sight_"), 0) for site in SIGHTS}
    values |= {"assumes_clear": clear, "assumes_closing": closing}
    return {site: torch.tensor([value]) for site, value in values.items()}


def first_round(recordings):
    """Observations ``[1, T, ...]`` and actions ``[1, T]`` of the first round."""
    observation = {name: value[:1, 0, :STEPS] for name, value in recordings.observation().items()}
    return observation, recordings.actions[:1, 0]

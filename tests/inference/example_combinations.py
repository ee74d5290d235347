"""A person with few combinations of discrete implants, and implants of their policy."""

import torch
from example_views import policies

LENGTHS = [[15, 15, 6], [], [15, 9]]
SITES = ("sight_front_own", "assumes_clear")
COMBINATIONS = dict(zip(SITES, torch.unravel_index(torch.arange(14), (7, 2)), strict=True))
PRIOR = torch.outer(torch.arange(1.0, 8) / 28, torch.tensor([0.3, 0.7])).flatten()


def some_policy(human, people=1):
    return {name: value[0] for name, value in policies(human, 1, people).items()}


def fixed_policy(people, consistency):
    return {
        "consistency": consistency * torch.ones(people, 1),
        "lapse": torch.full((people, 1), 0.02),
        "residual_in": torch.zeros(people, 1, 49, 8),
        "residual_out": torch.zeros(people, 1, 9, 2),
    }

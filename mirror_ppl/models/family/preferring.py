"""People who want something else."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.models.human import HumanModel, Implants

SHARES_GOAL = "shares_goal"
"""Site of how far the robot's action values are theirs."""
PREFERS = "prefers_"
"""What sites of preferences begin with."""


class Preferring(HumanModel):
    """Wants something else: another goal, more or less caution, a habit.

    ``shares_goal`` is how far the robot's action values are theirs: 1 for all of it, 0 for not at
    all, -1 for the opposite. ``prefers_<action>`` is added to the log-probability of an action,
    whatever it leads to (lapses, too), before normalization; it is 0 for the first action::

        shares_goal_p ~ Uniform(-1, 1)
        prefers_a_p   ~ Normal(0, 1.5)
        p(a | z)      ~ exp(prefers_a) p(a | z, shares_goal * Q(z)), normalized
    """

    @property
    def preferences(self) -> tuple[str, ...]:
        """Sites of all actions but the first."""
        return tuple(PREFERS + action.replace(" ", "_") for action in self.domain.actions[1:])

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, and what they prefer."""
        one = next(self.self_model.parameters()).new_ones(())
        preferences = {
            site: pyro.sample(site, dist.Normal(0 * one, 1.5 * one)) for site in self.preferences
        }
        shares = pyro.sample(SHARES_GOAL, dist.Uniform(-one, one))
        return super().prior() | preferences | {SHARES_GOAL: shares}

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Log-probabilities of actions ``[..., P, B, A]``."""
        shared = implants[SHARES_GOAL][..., None] * values
        others = [implants[site] for site in self.preferences]
        liked = torch.stack([torch.zeros_like(others[0]), *others], -1)
        return torch.log_softmax(super().act(implants, belief, shared) + liked, -1)

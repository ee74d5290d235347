"""A model of people with other preferences than the robot."""

from __future__ import annotations

import re

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.implants import MOTOR_NOISE, executed

SHARES_GOAL = "shares_goal"
"""Site of the factor on the robot's action values."""
PREFERS = "prefers_"
"""Prefix of the sites of preferences."""


class Preferring(HumanModel):
    """Has other preferences than the robot: another goal, more or less caution, a habit.

    ``shares_goal`` scales the robot's action values: 1 for the robot's goal, 0 for none, -1 for the
    opposite. ``prefers_<action>`` is added to the log-probability of an action (of lapses, too)
    before normalization, whatever the action leads to; it is 0 for the first action::

        (1 + shares_goal_p) / 2 ~ Beta(2, 1)
        prefers_a_p             ~ Normal(0, 1.5)
        p(a | z)                ~ exp(prefers_a) p(a | z, shares_goal * Q(z)), normalized
    """

    @property
    def preferences(self) -> tuple[str, ...]:
        """Names of the sites of preferences, one for each action but the first."""
        words = (re.sub(r"[^\w-]+", "_", action) for action in self.domain.actions[1:])
        return tuple(PREFERS + word for word in words)

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, with their preferences."""
        one = next(self.self_model.parameters()).new_ones(())
        preferences = {
            site: pyro.sample(site, dist.Normal(0 * one, 1.5 * one)) for site in self.preferences
        }
        # Most people share the robot's goal: the density rises from 0 at -1 to 1 at 1.
        shared = dist.AffineBeta(2 * one, one, -one, 2 * one)
        shares = pyro.sample(SHARES_GOAL, shared)
        return super().prior() | preferences | {SHARES_GOAL: shares}

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Return log-probabilities of actions ``[..., P, B, A]``."""
        shared = implants[SHARES_GOAL][..., None] * values
        others = [implants[site] for site in self.preferences]
        liked = torch.stack([torch.zeros_like(others[0]), *others], -1)
        if MOTOR_NOISE not in implants:
            return torch.log_softmax(super().act(implants, belief, shared) + liked, -1)
        # People prefer what they intend, and execute it with noise.
        precise = {site: value for site, value in implants.items() if site != MOTOR_NOISE}
        intended = torch.log_softmax(super().act(precise, belief, shared) + liked, -1)
        return executed(self.domain, implants, intended)

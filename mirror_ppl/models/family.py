"""A family of human models: people who react late, who want something else, or who do not hear.

Each is a program of its own, to fit, simulate and calibrate. :class:`AnyKind` is the first two and
the package's own model at once: which of them holds for a person is a site, ``kind``. Its
posterior weighs the models by their marginal likelihoods, and what they share, predictions and
plans are averages over them (Bayesian model averaging)::

    kind_p          ~ Categorical(.8, .1, .1)            mirror, late, preferring
    late_p          ~ Beta(4, 1)                         of those who are late
    shares_goal_p   ~ Uniform(-1, 1)                     of those who prefer something else
    prefers_a_p     ~ Normal(0, 1.5)                     of them; 0 for the first action
    a_t             ~ (1 - late) p(a | zH_t) + late p(a | zH_{t-1})
    p(a | z)        ~ exp(prefers_a) p(a | z, shares_goal * Q(z)), normalized

Implants of the other models keep their prior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.implants import LEAST_PROBABILITY
from mirror_ppl.models.view import View

KIND, LATE, SHARES_GOAL = "kind", "late", "shares_goal"
"""Sites of the kind, of lateness and of goals."""
PREFERS, HEARS = "prefers_", "hears_"
"""What names of preferences and of channels that are heard begin with."""
KINDS = {"mirror": 0.8, "late": 0.1, "preferring": 0.1}
"""The models of the family with their prior probabilities."""


class Late(HumanModel):
    """Acts at most steps on the belief of the step before; at the first there is only one.

    A belief is the robot's, and behind it that of the step before: ``[..., 2 Z]``.
    """

    @property
    def belief_size(self) -> int:
        """Two beliefs of the robot's size."""
        return 2 * super().belief_size

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person; ``late`` is how often they react late."""
        one = next(self.self_model.parameters()).new_ones(())
        return super().prior() | {LATE: pyro.sample(LATE, dist.Beta(4 * one, one))}

    def believe(
        self, belief: Tensor, evidence: Tensor, action: Tensor, still: Tensor | None = None
    ) -> Tensor:
        """The belief after one step, and the one before it."""
        before, _ = belief.chunk(2, -1)
        found = super().believe(before, evidence, action, still)
        now = found if isinstance(found, Tensor) else found.mean
        first = action == len(self.domain.actions)
        return torch.cat([now, torch.where(first[..., None], now, before)], -1)

    def action_values(self, belief: Tensor) -> Tensor:
        """Action values ``[..., 2 A]`` at both beliefs."""
        values = super().action_values
        return torch.cat([values(part) for part in belief.chunk(2, -1)], -1)

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Log-probabilities of actions ``[..., P, B, A]``; some follow the belief before."""
        (now, before), both = belief.chunk(2, -1), values.chunk(2, -1)
        late = implants[LATE][..., None].clamp(LEAST_PROBABILITY, 1 - LEAST_PROBABILITY)
        return torch.logaddexp(
            torch.log1p(-late) + super().act(implants, now, both[0]),
            torch.log(late) + super().act(implants, before, both[1]),
        )


class Preferring(HumanModel):
    """Wants something else: another goal, more or less caution, a habit.

    ``shares_goal`` is how far the robot's action values are theirs: 1 for all of it, 0 for not at
    all, -1 for the opposite. ``prefers_<action>`` is added to the log-probability of an action,
    whatever it leads to (lapses, too), before normalization; it is 0 for the first action.
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


class HardOfHearing(HumanModel):
    """Does not take in what is communicated by some channels: ``hears_<modality>``, 1 if they do.

    It is inferred from recordings with messages, such as rounds in which a communicator assists.
    """

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, and the channels that reach them."""
        even = next(self.self_model.parameters()).new_full((2,), 1 / 2)
        hears = {
            site: pyro.sample(site, dist.Categorical(even))
            for site in (HEARS + modality.name for modality in self.domain.modalities)
        }
        return super().prior() | hears

    def perceive(
        self,
        implants: Implants,
        knowledge: Any,
        observation: Observation,
        told: Visibility,
        step: int,
    ) -> tuple[View, Any]:
        """What a person sees, and of what is communicated what reaches them."""
        reaches = {
            name: mask & (implants[HEARS + name][..., None] == 1) for name, mask in told.items()
        }
        return super().perceive(implants, knowledge, observation, reaches, step)


class AnyKind(Late, Preferring):
    """People whose kind is unknown: each is inferred together with the other implants."""

    value_names: Mapping[str, Sequence[str]] = MappingProxyType({KIND: tuple(KINDS)})
    stratified_by = KIND

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, of all kinds, and their kind."""
        probabilities = torch.tensor(list(KINDS.values())).to(next(self.self_model.parameters()))
        return super().prior() | {KIND: pyro.sample(KIND, dist.Categorical(probabilities))}

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Log-probabilities of actions ``[..., P, B, A]``, as their kind has it."""
        names, own = list(KINDS), dict(implants)
        preferring = implants[KIND] == names.index("preferring")
        own[LATE] = torch.where(implants[KIND] == names.index("late"), own[LATE], 0.0)
        own[SHARES_GOAL] = torch.where(preferring, own[SHARES_GOAL], 1.0)
        for site in self.preferences:
            own[site] = torch.where(preferring, own[site], 0.0)
        return super().act(own, belief, values)

"""Variants of the human model: other families of sight, and parts left out to compare with.

Every command takes their names for ``--human-model``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility, by_eye
from mirror_ppl.errors import HumanModelError
from mirror_ppl.models import implants as implant_priors
from mirror_ppl.models.family import (
    AnyKind,
    Forgetting,
    HardOfHearing,
    Late,
    Noticing,
    Preferring,
)
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.self_model import SelfModel


class OneRadius(HumanModel):
    """Sees equally far in every direction: ``sight_radius`` instead of directional thresholds."""

    RADIUS = implant_priors.SIGHT + "radius"

    def __init__(self, self_model: SelfModel) -> None:
        super().__init__(self_model)
        if len(self.domain.reach_bins) <= 1:
            raise HumanModelError(
                f"one-radius: in {self.domain.name} it does not count how far away things are"
            )

    def prior(self) -> dict[str, Tensor]:
        """Sample the radius, what is taken for granted, and how people decide."""
        domain, like = self.domain, next(self.self_model.parameters())
        return (
            {self.RADIUS: implant_priors.reach_implant(self.RADIUS, domain, like)}
            | implant_priors.assumption_implants(domain, like)
            | implant_priors.policy_implants(domain, self.self_model.latent, like)
        )

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """The same reach in each direction."""
        radius = implants[self.RADIUS]
        reach = dict.fromkeys(implant_priors.sight_sites(self.domain), radius)
        return super().sees(reach, observation, step)


class PerItem(HumanModel):
    """Notices each item sooner or later: the family of bomb defusal (supplement, section C).

    At every step of a round somebody notices an item ``k`` that they have not noticed with their
    own probability ``notices_k``, and from there on they see it, wherever it is::

        notices_k   ~ Beta(1, 1)                          probability at a step
        noticed_k,b ~ Geometric(notices_k), from step 0   in each round b; the horizon for never
        n_t,k       = noticed_k,b <= t
    """

    def prior(self) -> dict[str, Tensor]:
        """Sample the probabilities, what is taken for granted, and how people decide."""
        domain, like = self.domain, next(self.self_model.parameters())
        return (
            implant_priors.notice_implants(domain, like)
            | implant_priors.assumption_implants(domain, like)
            | implant_priors.policy_implants(domain, self.self_model.latent, like)
        )

    def round_latents(self, implants: Implants) -> dict[str, Tensor]:
        """Sample when each item is noticed."""
        return implant_priors.notice_times(self.domain, implants)

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """What was noticed at this step or before."""
        times = [implants[site] for site in implant_priors.noticed_sites(self.domain)]
        noticed = torch.stack(torch.broadcast_tensors(*times), -1) <= step
        direction, _ = self.domain.distance(observation)
        noticed = noticed.expand(torch.broadcast_shapes(noticed.shape, direction.shape))
        return by_eye(self.domain, noticed)


class PerceptualOnly(HumanModel):
    """Differs from the robot in what they see, not in their policy: no residual."""

    def prior(self) -> dict[str, Tensor]:
        """Sample what people see and how strictly they choose."""
        like = next(self.self_model.parameters())
        return implant_priors.perceptual_implants(
            self.domain, like
        ) | implant_priors.choice_implants(like)


class NoImplants(HumanModel):
    """The robot itself, but for how strictly it chooses: sees everything, no residual."""

    def prior(self) -> dict[str, Tensor]:
        """Sample how strictly people choose."""
        return implant_priors.choice_implants(next(self.self_model.parameters()))

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Everything that could be seen."""
        direction, _ = self.domain.distance(observation)
        return by_eye(self.domain, torch.ones_like(direction, dtype=torch.bool))


class PolicyOnly(NoImplants):
    """Differs from the robot in their policy, not in what they see."""

    def prior(self) -> dict[str, Tensor]:
        """Sample how people decide."""
        like = next(self.self_model.parameters())
        return implant_priors.policy_implants(self.domain, self.self_model.latent, like)


VARIANTS: dict[str, type[HumanModel]] = {
    "mirror": HumanModel,
    "one-radius": OneRadius,
    "per-item": PerItem,
    "perceptual-only": PerceptualOnly,
    "policy-only": PolicyOnly,
    "no-implants": NoImplants,
    "late": Late,
    "noticing": Noticing,
    "forgetting": Forgetting,
    "preferring": Preferring,
    "hard-of-hearing": HardOfHearing,
    "all": AnyKind,
}
"""Human models of the package by the names that commands take; the first is what they fit."""

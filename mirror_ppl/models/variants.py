"""Variants of the human model: other families of sight, and ablations.

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
from mirror_ppl.shapes import broadcast_shapes


class OneRadius(HumanModel):
    """Sees equally far in every direction: ``sight_radius`` instead of directional thresholds."""

    RADIUS = implant_priors.SIGHT + "radius"

    def __init__(self, self_model: SelfModel) -> None:
        super().__init__(self_model)
        if len(self.domain.reach_bins) <= 1:
            raise HumanModelError(
                f"one-radius: in {self.domain.name} distance does not matter, so there is no radius"
            )

    def prior(self) -> dict[str, Tensor]:
        """Sample the radius, the assumptions and the policy implants."""
        domain, like = self.domain, next(self.self_model.parameters())
        return (
            {self.RADIUS: implant_priors.reach_implant(self.RADIUS, domain, like)}
            | implant_priors.assumption_implants(domain, like)
            | implant_priors.policy_implants(domain, self.self_model.latent, like)
        )

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Return what is within the radius."""
        radius = implants[self.RADIUS]
        reach = dict.fromkeys(implant_priors.sight_sites(self.domain), radius)
        return super().sees(reach, observation, step)


class PerItem(HumanModel):
    """Notices each item after a random delay, as in bomb defusal (supplement, section C).

    At every step of a round a person notices each unnoticed item ``k`` with probability
    ``notices_k``. From then on they see it, wherever it is::

        notices_k   ~ Beta(1, 1)                          probability at a step
        noticed_k,b ~ Geometric(notices_k), from step 0   in each round b; the horizon for never
        n_t,k       = noticed_k,b <= t
    """

    def prior(self) -> dict[str, Tensor]:
        """Sample the probabilities, the assumptions and the policy implants."""
        domain, like = self.domain, next(self.self_model.parameters())
        return (
            implant_priors.notice_implants(domain, like)
            | implant_priors.assumption_implants(domain, like)
            | implant_priors.policy_implants(domain, self.self_model.latent, like)
        )

    def round_latents(self, implants: Implants) -> dict[str, Tensor]:
        """Sample the step at which each item is noticed."""
        return implant_priors.notice_times(self.domain, implants)

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Return what was noticed at this step or before."""
        times = [implants[site] for site in implant_priors.noticed_sites(self.domain)]
        noticed = torch.stack(torch.broadcast_tensors(*times), -1) <= step
        direction, _ = self.domain.distance(observation)
        noticed = noticed.expand(broadcast_shapes(noticed.shape, direction.shape))
        return by_eye(self.domain, noticed)


class PerceptualOnly(HumanModel):
    """Differs from the robot in perception, not in policy: no residual."""

    def prior(self) -> dict[str, Tensor]:
        """Sample the perceptual implants and the parameters of choices."""
        like = next(self.self_model.parameters())
        return implant_priors.perceptual_implants(
            self.domain, like
        ) | implant_priors.choice_implants(self.domain, like)


class NoImplants(HumanModel):
    """The robot itself, except for the parameters of choices: sees everything, no residual."""

    def prior(self) -> dict[str, Tensor]:
        """Sample the parameters of choices."""
        return implant_priors.choice_implants(self.domain, next(self.self_model.parameters()))

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Return everything that could be seen."""
        direction, _ = self.domain.distance(observation)
        return by_eye(self.domain, torch.ones_like(direction, dtype=torch.bool))


class PolicyOnly(NoImplants):
    """Differs from the robot in policy, not in perception."""

    def prior(self) -> dict[str, Tensor]:
        """Sample the policy implants."""
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

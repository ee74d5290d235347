"""Variants of the human model: other families of sight, and parts left out to compare with.

Every command takes their names for ``--human-model``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.models import implants as implant_priors
from mirror_ppl.models.human import HumanModel, Implants


class OneRadius(HumanModel):
    """Sees equally far in every direction: ``sight_radius`` instead of directional thresholds."""

    RADIUS = implant_priors.SIGHT + "radius"

    def prior(self) -> dict[str, Tensor]:
        """Sample the radius, what is taken for granted, and how people decide."""
        domain, like = self.domain, next(self.self_model.parameters())
        return (
            {self.RADIUS: implant_priors.reach_implant(self.RADIUS, domain, like)}
            | implant_priors.assumption_implants(domain, like)
            | implant_priors.policy_implants(domain, self.self_model.latent, like)
        )

    def sees(self, implants: Implants, observation: Observation) -> Visibility:
        """The same reach in each direction."""
        radius = implants[self.RADIUS]
        return super().sees(
            dict.fromkeys(implant_priors.sight_sites(self.domain), radius), observation
        )


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

    def sees(self, implants: Implants, observation: Observation) -> Visibility:
        """Everything that could be seen."""
        direction, _ = self.domain.distance(observation)
        everything = torch.ones_like(direction, dtype=torch.bool)
        return {
            modality.name: everything if modality.name == "visual" else ~everything
            for modality in self.domain.modalities
        }


class PolicyOnly(NoImplants):
    """Differs from the robot in their policy, not in what they see."""

    def prior(self) -> dict[str, Tensor]:
        """Sample how people decide."""
        like = next(self.self_model.parameters())
        return implant_priors.policy_implants(self.domain, self.self_model.latent, like)


VARIANTS: dict[str, type[HumanModel]] = {
    "mirror": HumanModel,
    "one-radius": OneRadius,
    "perceptual-only": PerceptualOnly,
    "policy-only": PolicyOnly,
    "no-implants": NoImplants,
}
"""Human models of the package by the names that commands take; the first is what they fit."""

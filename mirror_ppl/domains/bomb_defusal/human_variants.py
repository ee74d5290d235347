"""Variants of the human model of bomb defusal: ablations and other families."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.domains.bomb_defusal.human import BombDefusalHuman
from mirror_ppl.models import implants as implant_priors
from mirror_ppl.models.family import HardOfHearing, Late, OneOfKinds, Preferring
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.variants import NoImplants
from mirror_ppl.models.view import View


class BombDefusalPerceptualOnly(BombDefusalHuman):
    """Searches and guesses, but decides like the robot: by its rules, without a residual."""

    def prior(self) -> dict[str, Tensor]:
        """Sample the perceptual implants and the parameters of choices."""
        like = next(self.self_model.parameters())
        return self.perceptual_implants() | implant_priors.choice_implants(self.domain, like)

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Return log-probabilities of actions by the robot's values."""
        return HumanModel.act(self, implants, belief, values)


class BombDefusalPolicyOnly(BombDefusalHuman):
    """Knows the rules and sees everything at once, without a search."""

    round_latents = HumanModel.round_latents
    covariates = HumanModel.covariates
    log_proposal = HumanModel.log_proposal
    spans = HumanModel.spans

    def prior(self) -> dict[str, Tensor]:
        """Sample the rules and the policy implants."""
        like = next(self.self_model.parameters())
        return self.rules() | implant_priors.policy_implants(
            self.domain, self.self_model.latent, like
        )

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Return everything, including the type."""
        del implants, step
        return _everything(observation)

    def perceive(self, implants, knowledge, observation, told, step) -> tuple[View, object]:
        """Return the view of :class:`HumanModel`, without a guess."""
        return HumanModel.perceive(self, implants, knowledge, observation, told, step)


class BombDefusalNoImplants(NoImplants):
    """The robot itself, except for choice parameters: sees everything, including the type."""

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Return everything, including the type."""
        del implants, step
        return _everything(observation)


class BombDefusalLate(Late, BombDefusalHuman):
    """Searches and guesses, and reacts late."""


class BombDefusalPreferring(Preferring, BombDefusalHuman):
    """Searches and guesses, and prefers some buttons."""


class BombDefusalHardOfHearing(HardOfHearing, BombDefusalHuman):
    """Searches and guesses; messages through some channels do not reach them."""

    spans = BombDefusalHuman.spans


class BombDefusalAnyKind(OneOfKinds, Late, Preferring, BombDefusalHuman):
    """Searches and guesses; the kind of each person is inferred."""

    members = MappingProxyType(
        {
            "mirror": BombDefusalHuman,
            "late": BombDefusalLate,
            "preferring": BombDefusalPreferring,
        }
    )


def _everything(observation: Observation) -> Visibility:
    return {
        name: torch.ones(value.shape[:-1], dtype=torch.bool, device=value.device)
        for name, value in observation.items()
        if name != "ego"
    }


HUMAN_MODELS: Mapping[str, type[HumanModel]] = {
    "mirror": BombDefusalHuman,
    "perceptual-only": BombDefusalPerceptualOnly,
    "policy-only": BombDefusalPolicyOnly,
    "no-implants": BombDefusalNoImplants,
    "late": BombDefusalLate,
    "preferring": BombDefusalPreferring,
    "hard-of-hearing": BombDefusalHardOfHearing,
    "all": BombDefusalAnyKind,
}
"""Classes that replace the human models of these names."""

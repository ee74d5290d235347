"""Variants of the model of bomb defusal, with parts left out to compare with."""

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
    """Searches and guesses, but decides as the robot does: by its rules, without a residual."""

    def prior(self) -> dict[str, Tensor]:
        """Sample how quick they are, whether they read the type, and how strictly they choose."""
        like = next(self.self_model.parameters())
        return self.perceptual_implants() | implant_priors.choice_implants(like)

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Choose as the robot would."""
        return HumanModel.act(self, implants, belief, values)


class BombDefusalPolicyOnly(BombDefusalHuman):
    """Knows the rules, and sees all that there is at once: nothing is left to be searched."""

    round_latents = HumanModel.round_latents
    covariates = HumanModel.covariates
    log_proposal = HumanModel.log_proposal
    spans = HumanModel.spans

    def prior(self) -> dict[str, Tensor]:
        """Sample their rules, and how they decide."""
        like = next(self.self_model.parameters())
        return self.rules() | implant_priors.policy_implants(
            self.domain, self.self_model.latent, like
        )

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Everything, also the type."""
        del implants, step
        return _everything(observation)

    def perceive(self, implants, knowledge, observation, told, step) -> tuple[View, object]:
        """As everywhere; there is nothing to guess."""
        return HumanModel.perceive(self, implants, knowledge, observation, told, step)


class BombDefusalNoImplants(NoImplants):
    """The robot itself, but for how strictly it chooses: sees everything, also the type."""

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Everything."""
        del implants, step
        return _everything(observation)


class BombDefusalLate(Late, BombDefusalHuman):
    """Searches and guesses, and reacts late."""


class BombDefusalPreferring(Preferring, BombDefusalHuman):
    """Searches and guesses, and prefers some buttons."""


class BombDefusalHardOfHearing(HardOfHearing, BombDefusalHuman):
    """Searches and guesses; messages by some channels do not reach them."""

    spans = BombDefusalHuman.spans


class BombDefusalAnyKind(OneOfKinds, Late, Preferring, BombDefusalHuman):
    """Searches and guesses; of which kind they are is open."""

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
"""What stands here for the human models of these names."""

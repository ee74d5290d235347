"""The human model of a person whose sight is known: an upper bound on what inference can add."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import torch
from pyro.distributions import Categorical
from pyro.poutine.messenger import Messenger
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains.base import Domain
from mirror_ppl.errors import InputError
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import ASSUMES, SIGHT
from mirror_ppl.models.self_model import SelfModel

ROUNDING = 1e-4
"""Distances that differ by less are equal."""


class KnownSight(HumanModel):
    """A human model with perceptual implants fixed at ``known`` values, by site."""

    known: Mapping[str, Tensor] = MappingProxyType({})

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, known ones fixed."""
        with FixedSites(self.known):
            return super().prior()


class FixedSites(Messenger):
    """Fixes sites with finite support at one value, given by name as its index ``[]``."""

    def __init__(self, values: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.values = values

    def _pyro_sample(self, message: Any) -> None:
        if message["name"] in self.values:
            probabilities = message["fn"].probs
            only = torch.zeros_like(probabilities)
            only[..., int(self.values[message["name"]])] = 1.0
            message["fn"] = Categorical(only)


def known_sight(self_model: SelfModel, person: Demonstrations) -> KnownSight:
    """Make the human model of a simulated person, given their true perceptual implants.

    Raises:
        InputError: the recording lacks the true values.
    """
    truth = {
        name: value
        for name, value in person.truth.items()
        if name.startswith((SIGHT, ASSUMES)) and not bool(value.isnan().any())
    }
    if not truth:
        raise InputError(f"recordings of {person.domain} lack the truth of what people see")
    human = KnownSight(self_model)
    human.known = {name: _place_of(human.domain, name, value[0]) for name, value in truth.items()}
    return human


def _place_of(domain: Domain, site: str, value: Tensor) -> Tensor:
    """Index of a site's value among its possible values."""
    if not site.startswith(SIGHT):
        return value.long()
    bins = torch.tensor(domain.reach_bins).to(value)
    return (bins <= value + ROUNDING).sum() - 1

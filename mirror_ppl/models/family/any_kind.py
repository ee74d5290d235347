"""The family of human models as one program.

Which of them holds for a person is a site, ``kind``. Its posterior weighs the models by their
marginal likelihoods, and what they share, predictions and plans are averages over them (Bayesian
model averaging)::

    kind_p ~ Categorical(.6, .1, .1, .1, .1)      mirror, late, noticing, forgetting, preferring

Implants of the other models keep their prior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import ClassVar

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.models.family.forgetting import FORGETS, Forgetting
from mirror_ppl.models.family.late import LATE, Late
from mirror_ppl.models.family.noticing import NOTICES, Noticing
from mirror_ppl.models.family.preferring import PREFERS, SHARES_GOAL, Preferring
from mirror_ppl.models.human import HumanModel, Implants

KIND = "kind"
"""Site of the kind."""
MIRROR = "mirror"
"""The package's own model."""
USUAL = 0.6
"""Prior probability of that; the others share the rest."""
SITES = {
    LATE: ("late", 0.0),
    NOTICES: ("noticing", 1.0),
    FORGETS: ("forgetting", 0.0),
    SHARES_GOAL: ("preferring", 1.0),
    PREFERS: ("preferring", 0.0),
}
"""Of each site that a model adds (of preferences, how they begin): that model, and the value at
which it is the package's own."""


def model_of(site: str) -> str:
    """The model of the family that adds a site; none, an empty name, if they share it."""
    return SITES.get(PREFERS if site.startswith(PREFERS) else site, ("", 0.0))[0]


class OneOfKinds(HumanModel):
    """People whose kind is unknown: it is inferred together with the other implants.

    Derive from it and from the models, which differ from the package's own in one respect each.
    """

    members: ClassVar[Mapping[str, type[HumanModel]]]
    """The models by name, ``mirror`` first."""
    stratified_by = KIND

    @property
    def family(self) -> tuple[str, ...]:
        """Names of the models."""
        return tuple(self.members)

    @property
    def value_names(self) -> Mapping[str, Sequence[str]]:
        """What the kinds are called."""
        return {**super().value_names, KIND: self.family}

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, of all kinds, and their kind."""
        other = (1 - USUAL) / (len(self.family) - 1)
        chances = torch.tensor([USUAL, *[other] * (len(self.family) - 1)])
        chances = chances.to(next(self.self_model.parameters()))
        return super().prior() | {KIND: pyro.sample(KIND, dist.Categorical(chances))}

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Log-probabilities of actions ``[..., P, B, A]``, as their kind has it."""
        own = dict(implants)
        for site, value in implants.items():
            if kind := model_of(site):
                _, usual = SITES[PREFERS if site.startswith(PREFERS) else site]
                own[site] = torch.where(implants[KIND] == self.family.index(kind), value, usual)
        return super().act(own, belief, values)


class AnyKind(OneOfKinds, Late, Noticing, Forgetting, Preferring):
    """People of any kind of the family."""

    members = MappingProxyType(
        {
            MIRROR: HumanModel,
            "late": Late,
            "noticing": Noticing,
            "forgetting": Forgetting,
            "preferring": Preferring,
        }
    )

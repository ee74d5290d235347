"""The family of human models as one program, a mixture over models.

The model of a person is a site, ``kind``. Its posterior weighs the models by their marginal
likelihoods. Shared implants, predictions and plans are averages over models (Bayesian model
averaging)::

    kind_p ~ Categorical(.6, .1, .1, .1, .1)      mirror, late, noticing, forgetting, preferring

Implants of models other than a person's own follow their prior.
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
"""Site of the model that holds for a person."""
MIRROR = "mirror"
"""The package's own model."""
USUAL = 0.6
"""Prior probability of ``mirror``; the other models share the rest equally."""
SITES = {
    LATE: ("late", 0.0),
    NOTICES: ("noticing", 1.0),
    FORGETS: ("forgetting", 0.0),
    SHARES_GOAL: ("preferring", 1.0),
    PREFERS: ("preferring", 0.0),
}
"""The model that adds each site (for preferences, each prefix), and the value of the site at which
that model equals the package's own."""


def model_of(site: str) -> str:
    """Return the model of the family that adds a site; an empty name if the models share it."""
    return SITES.get(PREFERS if site.startswith(PREFERS) else site, ("", 0.0))[0]


class OneOfKinds(HumanModel):
    """Base class of mixtures of models: the kind of each person is inferred with other implants.

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
        """Names of the values of discrete sites, including ``kind``."""
        return {**super().value_names, KIND: self.family}

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of all models, and the kind, of every person."""
        other = (1 - USUAL) / (len(self.family) - 1)
        probabilities = torch.tensor([USUAL, *[other] * (len(self.family) - 1)])
        probabilities = probabilities.to(next(self.self_model.parameters()))
        return super().prior() | {KIND: pyro.sample(KIND, dist.Categorical(probabilities))}

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Return log-probabilities of actions ``[..., P, B, A]`` under each person's kind."""
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

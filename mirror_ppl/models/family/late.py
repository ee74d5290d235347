"""A model of people who act a step late."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.models.family.several import NOW, SeveralBeliefs
from mirror_ppl.models.human import Implants

LATE = "late"
"""Site of the probability of acting on the belief of the step before."""
BEFORE = "before"
"""The belief of the step before."""


class Late(SeveralBeliefs):
    """Acts at most steps on the belief of the step before; a first step has only its own::

    late_p ~ Beta(4, 1)
    a_t    ~ (1 - late) p(a | zH_t) + late p(a | zH_{t-1})
    """

    @property
    def beliefs(self) -> tuple[str, ...]:
        """Names of the beliefs, with that of the step before."""
        return (*super().beliefs, BEFORE)

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, with the probability ``late``."""
        one = next(self.self_model.parameters()).new_ones(())
        return super().prior() | {LATE: pyro.sample(LATE, dist.Beta(4 * one, one))}

    def after(self, before, evidence, action, still) -> dict[str, Tensor]:
        """Return the beliefs after one step, and the belief before it."""
        found = super().after(before, evidence, action, still)
        first = (action == len(self.domain.actions))[..., None]
        return found | {BEFORE: torch.where(first, found[NOW], before[NOW])}

    def shares(self, implants: Implants) -> dict[str, Tensor]:
        """Return the probabilities of acting on each belief."""
        found = super().shares(implants)
        late = found[NOW] * implants[LATE]
        return found | {NOW: found[NOW] - late, BEFORE: late}

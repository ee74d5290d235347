"""A model of people who act on what they believed one or more steps before."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.models.family.several import NOW, SeveralBeliefs
from mirror_ppl.models.human import Implants

LATE = "late"
"""Site of the number of steps by which a person is late, which need not be whole."""
BEFORE = ("before 1", "before 2", "before 3")
"""Beliefs of one to three steps before."""


class Late(SeveralBeliefs):
    """Acts up to three steps late::

    late_p / 3 ~ Beta(2, 2)
    a_t        ~ sum_{n<=3} max(0, 1 - |late - n|) p(a | zH_{t-n})

    So a person who is 1.2 steps late acts four times of five on the belief of the step before, and
    otherwise on that of two steps before. The first belief of a round stands for earlier ones.
    """

    @property
    def beliefs(self) -> tuple[str, ...]:
        """Names of the beliefs, with those of the steps before."""
        return (*super().beliefs, *BEFORE)

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, with the number of steps ``late``."""
        one = next(self.self_model.parameters()).new_ones(())
        lateness = dist.AffineBeta(2 * one, 2 * one, 0 * one, len(BEFORE) * one)
        return super().prior() | {LATE: pyro.sample(LATE, lateness)}

    def after(self, before, evidence, action, still) -> dict[str, Tensor]:
        """Return the beliefs after one step, and those before it."""
        found = super().after(before, evidence, action, still)
        first = (action == len(self.domain.actions))[..., None]
        for name, later in zip(BEFORE, (NOW, *BEFORE[:-1]), strict=True):
            found[name] = torch.where(first, found[NOW], before[later])
        return found

    def shares(self, implants: Implants) -> dict[str, Tensor]:
        """Return the probabilities of acting on each belief."""
        found = super().shares(implants)
        now, late = found[NOW], implants[LATE]
        for steps, name in enumerate((NOW, *BEFORE)):
            found[name] = now * (1 - (late - steps).abs()).clamp(min=0)
        return found

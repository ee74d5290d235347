"""A person who reacts late: a human model with one implant more than the package's own.

    python -m mirror_ppl.fit --human-model docs/examples/late_reactions.py:LatePerson

With probability ``late``, an action follows the belief of one step before::

    late_p ~ Beta(1, 4)
    a_t    ~ (1 - late) pi(zH_t) + late pi(zH_{t-1})         pi: the package's own choice of actions

``docs/extending.md`` explains how to write such a class.
"""

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.models import HumanModel, Implants


class LatePerson(HumanModel):
    """The package's human model, with one sample site more, and a memory of one step.

    A belief is the robot's, and behind it that of the step before: ``[..., 2 Z]``.
    """

    @property
    def belief_size(self) -> int:
        """Two beliefs of the robot's size."""
        return 2 * self.self_model.latent

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person; ``late`` is how often they react late."""
        one = next(self.self_model.parameters()).new_ones(())  # on its device
        late = pyro.sample("late", dist.Beta(one, 4 * one))  # mean 0.2
        return super().prior() | {"late": late}

    def believe(
        self, belief: Tensor, evidence: Tensor, action: Tensor, still: Tensor | None = None
    ) -> Tensor:
        """The belief after one step, and the one before it."""
        before, _ = belief.chunk(2, -1)
        now = super().believe(before, evidence, action, still).mean  # of a Gaussian
        first = action == len(self.domain.actions)  # nothing was done before, nothing believed
        return torch.cat([now, torch.where(first[..., None], now, before)], -1)

    def action_values(self, belief: Tensor) -> Tensor:
        """Action values ``[..., 2 A]`` at both beliefs."""
        now, before = belief.chunk(2, -1)
        return torch.cat([super().action_values(now), super().action_values(before)], -1)

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Log-probabilities of actions ``[..., P, B, A]``; some follow the belief before."""
        beliefs, both = belief.chunk(2, -1), values.chunk(2, -1)
        now = super().act(implants, beliefs[0], both[0])
        before = super().act(implants, beliefs[1], both[1])
        late = implants["late"][..., None]  # [..., P, 1, 1]
        return torch.logaddexp(torch.log1p(-late) + now, torch.log(late) + before)

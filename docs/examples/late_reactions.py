"""A person who reacts late: a human model with one implant more than the package's own.

    python -m mirror_ppl.fit --human-model docs/examples/late_reactions.py:LatePerson

With probability ``late``, an action follows the belief of one step before::

    late_p ~ Beta(1, 4)
    a_t    ~ (1 - late) pi(zH_t) + late pi(zH_{t-1})         pi: the package's own choice of actions

How such a class comes about is told in ``docs/extending.md``.
"""

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.models import HumanModel, Implants


class LatePerson(HumanModel):
    """The package's human model, with one sample site more: ``late``."""

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Log-probabilities of actions ``[..., T, A]``; some follow the belief before."""
        one = belief.new_ones(())  # on the belief's device
        late = pyro.sample("late", dist.Beta(one, 4 * one))  # [..., P, 1]; mean 0.2
        late = late[..., None, None]  # [..., P, 1, 1, 1], beside [..., P, V, T, A]
        now = super().act(implants, belief, values)
        # The first action has no belief before it.
        before = torch.cat([now[..., :1, :], now[..., :-1, :]], -2)
        return torch.logaddexp(torch.log1p(-late) + now, torch.log(late) + before)

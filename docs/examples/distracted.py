"""A person who is distracted in some rounds: a human model in which rounds differ.

    python -m mirror_ppl.fit --human-model docs/examples/distracted.py:DistractedPerson

In a round in which they are, they see nothing by themselves::

    distracted_p ~ Beta(1, 4)                 share of rounds
    away_p,b     ~ Bernoulli(distracted_p)    in round b

``docs/extending.md`` explains how to write such a class.
"""

import pyro
import pyro.distributions as dist
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.models import HumanModel, Implants


class DistractedPerson(HumanModel):
    """The package's human model, with a latent that differs from round to round."""

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person; ``distracted`` is how often they are."""
        return super().prior() | {"distracted": pyro.sample("distracted", dist.Beta(1.0, 4.0))}

    def round_latents(self, implants: Implants) -> dict[str, Tensor]:
        """Sample in which rounds they are, ``[..., P, B]``."""
        return {"away": pyro.sample("away", dist.Bernoulli(implants["distracted"]))}

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Nothing in a round in which they are distracted."""
        seen = super().sees(implants, observation, step)
        present = implants["away"][..., None] == 0
        return {name: mask & present for name, mask in seen.items()}

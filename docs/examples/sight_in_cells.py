"""A person who sees up to a distance of their own: continuous sites that perception reads.

    python -m mirror_ppl.fit --human-model docs/examples/sight_in_cells.py:SightInCells

Cars are seen within two distances, in cells of the road::

    ahead_p  ~ LogNormal(1, .7)
    behind_p ~ LogNormal(0, .7)

``docs/extending.md`` explains how to write such a class.
"""

import pyro
import pyro.distributions as dist
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.domains.base import by_eye
from mirror_ppl.models import HumanModel


class SightInCells(HumanModel):
    """The package's human model of drivers with two reaches of sight, in cells of the road."""

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person, without the thresholds in bins."""
        sites = [f"sight_{direction}" for direction in self.domain.directions]
        hidden = poutine.block(super().prior, hide=sites)
        implants = {site: value for site, value in hidden().items() if site not in sites}
        implants["ahead"] = pyro.sample("ahead", dist.LogNormal(1.0, 0.7))  # median 2.7 cells
        implants["behind"] = pyro.sample("behind", dist.LogNormal(0.0, 0.7))
        return implants

    def sees(self, implants, observation, step) -> dict[str, Tensor]:
        """Return the cars within reach."""
        direction, distance = self.domain.distance(observation)
        ahead = torch.tensor([name.startswith("front") for name in self.domain.directions])
        reach = torch.where(
            ahead[direction], implants["ahead"][..., None], implants["behind"][..., None]
        )
        return by_eye(self.domain, distance <= reach)

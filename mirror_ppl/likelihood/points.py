"""Points: weighted draws of the sites that perception reads, where these cannot all be summed over.

Sites are continuous, or have too many combinations. Then sums over their values are estimated by
importance sampling: each point counts as often as the prior makes it more probable than what it was
drawn from. The first points are drawn from the prior; :mod:`mirror_ppl.inference.point_proposals`
adds others where the posterior is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.combinations import (
    discrete_sites,
    log_sampled,
    needs_points,
    perceived_names,
    perceived_sites,
)
from mirror_ppl.likelihood.grid import Grid, grid_of
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, draw_prior

FIRST_POINTS = 8192
"""Points that are drawn from the prior."""
CONDITIONS = 64
"""Draws of other sites on which the prior of points depends."""


def whole_grid(human: HumanModel, seed: int = 0) -> Grid:
    """The joint values that engines sum over: all combinations, or points from the prior.

    Args:
        human: the model of people.
        seed: of points.

    Raises:
        HumanModelError: perception reads a discrete site whose values are not 0, 1 and so on, or a
            continuous one that actions or other sites depend on, too.
    """
    if not needs_points(human):
        return grid_of(perceived_sites(human))
    return PriorPoints.of(human).draw(FIRST_POINTS, seed)


@dataclass(frozen=True)
class PriorPoints:
    """The distribution from which the first points are drawn.

    It is the prior of the sites that perception reads and of all on which these depend. Where these
    depend on a site that ``act`` reads, too, it is a mixture of conditional priors.

    Attributes:
        human: the model of people.
        sites: names of the points' sites, in the program's order.
        read: those that perception reads.
        given: values ``[S, 1, 1, ...]`` of the other sites, in equal shares; a single one where
            the points do not depend on them.
    """

    human: HumanModel
    sites: tuple[str, ...]
    read: tuple[str, ...]
    given: Draws

    @classmethod
    def of(cls, human: HumanModel) -> PriorPoints:
        """Find the points' sites.

        Raises:
            HumanModelError: ``act`` reads a continuous site that perception reads, or attention is
                sampled.
        """
        if human.has_round_latents and not human.chained:
            raise HumanModelError(
                "perceive() reads a continuous site, or too many discrete ones to sum over all "
                "their combinations, and round_latents has no spans: declare them"
            )
        found, read = dependencies(human), perceived_names(human)
        if both := set(read) & found.actions - discrete_sites(human).keys():
            names = ", ".join(sorted(both))
            raise HumanModelError(
                f"act() reads a continuous site that perceive() reads, too ({names}), which no "
                "engine can infer; sample two sites, and let the one that perceive() reads depend "
                "on the other"
            )
        sites = set(read)
        outside = False
        waiting = list(read)
        while waiting:
            for parent in found.prior[waiting.pop()] & found.latent:
                if parent in found.actions and parent not in sites:
                    outside = True
                elif parent not in sites:
                    sites.add(parent)
                    waiting.append(parent)
        others = draw_prior(human, 1, CONDITIONS if outside else 1, CONDITIONS)
        given = {name: value for name, value in others.items() if name not in sites}
        return cls(human, tuple(name for name in others if name in sites), read, given)

    @property
    def like(self) -> Tensor:
        """A tensor of the dtype and on the device of densities."""
        return next(self.human.parameters())

    def values(self, number: int, seed: int) -> dict[str, Tensor]:
        """Draw values ``[number, ...]``, deterministic given the seed."""
        own = draw_prior(self.human, 1, number, seed)
        return {name: own[name][:, 0, 0] for name in self.sites}

    def log_density(self, values: Mapping[str, Tensor]) -> Tensor:
        """Log density ``[M]`` of values ``[M, ...]``."""
        found = log_sampled(self.human, values, self.given)  # [S, M]
        return found.logsumexp(0) - math.log(len(found))

    def draw(self, number: int, seed: int) -> Grid:
        """Draw points."""
        values = self.values(number, seed)
        return Grid(
            values,
            log_proposal=self.log_density(values) + math.log(number),
            read=self.read,
        )

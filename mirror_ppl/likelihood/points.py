"""Points: weighted draws of the sites that perception reads, where these cannot all be summed over.

One of the sites is continuous, so sums over their values are estimated by importance sampling: each
point counts as often as the prior makes it more probable than what it was drawn from. The first
points are drawn from the prior; :mod:`mirror_ppl.inference.point_proposals` adds others where the
posterior is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.combinations import (
    log_sampled,
    needs_points,
    perceived_names,
    perceived_sites,
    why_points,
)
from mirror_ppl.likelihood.grid import Grid, grid_of
from mirror_ppl.models.dependencies import Dependencies, dependencies
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, draw_prior, sample_sites, values_of
from mirror_ppl.randomness import forked, seed_everything

FIRST_POINTS = 8192
"""Points that are drawn from the prior."""
SEED = 0
"""Seed of these."""
CONDITIONS = 512
"""Draws of other sites on which the prior of points depends."""


def whole_grid(human: HumanModel) -> Grid:
    """The joint values that engines sum over: all combinations, or points from the prior.

    The first points of all people are the same, so that errors of their evidences have a common
    part.

    Args:
        human: the model of people.

    Raises:
        HumanModelError: perception reads a discrete site whose values are not 0, 1 and so on, or
            points are needed and ``act`` reads a site that perception reads.
    """
    if not needs_points(human):
        return grid_of(perceived_sites(human))
    return PriorPoints.of(human).draw(FIRST_POINTS, SEED)


@dataclass(frozen=True)
class PriorPoints:
    """The distribution from which the first points are drawn.

    It is the prior of the sites that perception reads, and of all on which these alone depend. If
    they depend on sites that other parts of the program read, too, it is the mean of their priors
    given draws of those.

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
            HumanModelError: ``act`` reads a site that perception reads, or attention is sampled.
        """
        if human.has_round_latents and not human.chained:
            raise HumanModelError(
                f"{why_points(human)}, and round_latents has no spans: declare them"
            )
        found, read = dependencies(human), perceived_names(human)
        if both := set(read) & found.actions:
            raise HumanModelError(
                f"act() reads a site that perceive() reads, too ({', '.join(sorted(both))}), and "
                f"{why_points(human)}, which no engine can infer together; sample two sites, and "
                "let the one that perceive() reads depend on the other"
            )
        sites = _with_parents(found, read)
        depends = any(found.prior[site] & found.latent - sites for site in sites)
        others = draw_prior(human, 1, CONDITIONS if depends else 1, CONDITIONS)
        given = {name: value for name, value in others.items() if name not in sites}
        return cls(human, tuple(name for name in others if name in sites), read, given)

    @property
    def is_prior(self) -> bool:
        """True if this is the prior itself, whatever the other sites are."""
        return len(next(iter(self.given.values()), (0,))) == 1

    @property
    def like(self) -> Tensor:
        """A tensor of the dtype and on the device of densities."""
        return next(self.human.parameters())

    def values(self, number: int, seed: int) -> dict[str, Tensor]:
        """Draw values ``[number, ...]``, deterministic given the seed."""
        with forked():
            seed_everything(seed)
            which = torch.randint(len(next(iter(self.given.values()), (0,))), (number,))
            given = {name: value[which] for name, value in self.given.items()}
            drawn = values_of(sample_sites(self.human, 1, number, given))
        return {name: drawn[name][:, 0, 0] for name in self.sites}

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


def _with_parents(found: Dependencies, read: Sequence[str]) -> set[str]:
    """Sites that perception reads, and those on which these alone depend."""
    sites, waiting = set(read), list(read)
    while waiting:
        parents = found.prior[waiting.pop()] & found.latent - sites
        sites |= parents
        waiting += parents
    while True:
        elsewhere = set(found.actions).union(*found.round_latents.values())
        elsewhere = elsewhere.union(*(found.prior[site] for site in found.latent - sites))
        if not (others := (sites - set(read)) & elsewhere):
            return sites
        sites -= others

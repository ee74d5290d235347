"""Points near a person's posterior, for models whose perception cannot be summed out exactly.

The first points are drawn from the prior (:mod:`mirror_ppl.likelihood.points`), and few of them may
explain the rounds. Stage by stage, others are drawn around those that do, and views are compiled
anew for all that are left (adaptive multiple importance sampling; Cornuet, Marin, Mira and Robert,
2012). Each point counts by the ratio of its prior density and the mixture of all proposals so far.
A proposal is densest at the points around which it was fitted, which would count too little; its
density there leaves their own kernel out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.distributions import biject_to

from mirror_ppl.inference.adaptive_importance import ImportanceOptions, coarse, sample_importance
from mirror_ppl.inference.pareto import pareto_smoothed
from mirror_ppl.inference.weighted import Weighted, tempered
from mirror_ppl.likelihood.grid import Grid
from mirror_ppl.likelihood.points import PriorPoints
from mirror_ppl.likelihood.round_views import Rounds
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import sample_sites
from mirror_ppl.randomness import forked

ENOUGH = 200.0
"""Effective points, or draws if fewer are enough, at which no stage is added."""
STAGES = 6
"""Largest number of stages after the first."""
NEW_POINTS = 4096
"""Points of a stage."""
FROM_PRIOR = 0.2
"""Share of these that are drawn from the prior, so that weights are bounded."""
CENTRES = 512
"""Largest number of points around which others are drawn, chosen by their probabilities."""
LEARNED_FROM = 64.0
"""Least effective number of points around which others are drawn; probabilities are tempered until
it is reached."""
NOISE = 0.02
"""Share of the prior's variance that is not looked at: it hardly changes what is seen."""
INFORMED = 0.5
"""Variance, relative to the prior's, below which rounds inform about a direction."""
NEGLIGIBLE = 1e-3
"""Posterior probability of the points that are dropped between stages."""
ANYHOW = 0.5
"""Probability that a discrete site of a new point is drawn uniformly, in place of its centre's."""


@dataclass(frozen=True)
class Coordinates:
    """The space in which points are proposed: unconstrained for continuous sites.

    Attributes:
        transforms: from unconstrained space, of the continuous sites.
        shapes: shape of a value of each of these there.
        supports: of the discrete sites, ``[n]``.
        like: an empty tensor on the device of points, in double precision.
    """

    transforms: dict[str, Any]
    shapes: dict[str, torch.Size]
    supports: dict[str, Tensor]
    like: Tensor

    @classmethod
    def of(cls, human: HumanModel, grid: Grid) -> Coordinates:
        """Find the coordinates of a grid's sites."""
        with forked():
            kinds = {name: node["fn"] for name, node in sample_sites(human, 1).items()}
        supports = {
            site: kinds[site].enumerate_support(expand=False).flatten()
            for site in grid
            if kinds[site].has_enumerate_support
        }
        transforms = {site: biject_to(kinds[site].support) for site in grid if site not in supports}
        shapes = {site: own.inv(grid[site][:1]).shape[1:] for site, own in transforms.items()}
        like = next(human.parameters()).new_zeros(0, dtype=torch.double)
        return cls(transforms, shapes, supports, like)

    def places(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return the continuous sites of values ``[M, ...]`` in unconstrained space, ``[M, D]``."""
        number = len(next(iter(values.values())))
        parts = [own.inv(values[site]).reshape(number, -1) for site, own in self.transforms.items()]
        return torch.cat(
            [part.to(self.like) for part in (self.like.new_zeros(number, 0), *parts)], -1
        )

    def at(self, places: Tensor, like: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return continuous sites ``[M, ...]`` at places ``[M, D]``, with others' dtypes."""
        parts = places.split([shape.numel() for shape in self.shapes.values()], -1)
        return {
            site: own(part.to(like[site]).view(len(part), *self.shapes[site])).reshape(
                len(part), *like[site].shape[1:]
            )
            for (site, own), part in zip(self.transforms.items(), parts, strict=False)
        }

    def log_abs_det(self, values: Mapping[str, Tensor]) -> Tensor:
        """Log absolute determinant ``[M]`` of the map from unconstrained space, at these values."""
        total = self.like.new_zeros(len(next(iter(values.values()))))
        for site, own in self.transforms.items():
            found = own.log_abs_det_jacobian(own.inv(values[site]), values[site])
            total = total + found.reshape(len(total), -1).sum(-1)
        return total


@dataclass(frozen=True)
class Whitening:
    """Whitens points from the prior: coordinates with mean 0, variance 1 and no correlation.

    Attributes:
        coordinates: unconstrained space.
        mean: of points from the prior there ``[D]``.
        factor: matrix ``[D, D]`` by which centred places are multiplied.
        leading: number of the first whitened coordinates that have all but `NOISE` of the variance.
    """

    coordinates: Coordinates
    mean: Tensor
    factor: Tensor
    leading: int

    @classmethod
    def of(cls, coordinates: Coordinates, points: Grid) -> Whitening:
        """Fit the transformation to points from the prior."""
        places = coordinates.places(points)
        places = places[places.isfinite().all(-1)]
        centred = places - places.mean(0)
        scale = centred.square().mean(0).sqrt() + 1e-9
        correlation = (centred / scale).T @ (centred / scale) / len(places)
        variances, vectors = torch.linalg.eigh(correlation)
        variances, vectors = variances.flip(0).clamp(min=1e-9), vectors.flip(1)
        explained = variances.cumsum(0) - variances < (1 - NOISE) * variances.sum()
        factor = vectors / scale[:, None] / variances.sqrt()
        return cls(coordinates, places.mean(0), factor, int(explained.sum()))

    def whiten(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return whitened coordinates ``[M, D]`` of values ``[M, ...]``."""
        return (self.coordinates.places(values) - self.mean) @ self.factor

    def values(self, white: Tensor, like: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the continuous sites at whitened coordinates."""
        places = torch.linalg.solve(self.factor.T, white.T).T + self.mean
        return self.coordinates.at(places, like)

    def log_abs_det(self, values: Mapping[str, Tensor]) -> Tensor:
        """Log absolute determinant ``[M]`` of the map to whitened coordinates, at these values."""
        return torch.linalg.slogdet(self.factor).logabsdet - self.coordinates.log_abs_det(values)


@dataclass(frozen=True)
class Kernels:
    """A mixture of densities around n weighted points.

    Rounds inform about few directions of the whitened space. In these, the density is a mixture of
    Gaussians around the points, with centres drawn together so that it has the points' covariance
    (West, *Mixture models, Monte Carlo, Bayesian updating and dynamic models*, 1993); in all others
    it is a standard Gaussian, like the prior. Discrete sites are those of the centre or, at times,
    any.

    Attributes:
        whitening: the space.
        points: the weighted points, values ``[n, ...]``.
        numbers: of these among all points that were ever drawn ``[n]``.
        log_weights: normalized ``[n]``.
        directions: orthonormal, in whitened space ``[D, K]``.
        centres: ``[n, K]``.
        spread: standard deviations of the Gaussians ``[K]``.
    """

    whitening: Whitening
    points: Grid
    numbers: Tensor
    log_weights: Tensor
    directions: Tensor
    centres: Tensor
    spread: Tensor

    @classmethod
    def around(
        cls, whitening: Whitening, points: Grid, numbers: Tensor, probability: Tensor
    ) -> Kernels:
        """Fit kernels to points ``[n]`` with these numbers and probabilities."""
        white = whitening.whiten(points)
        inside = white.isfinite().all(-1)  # not at the boundary, as an exact 0 of a share
        white, points, numbers = white[inside], points.chosen(inside), numbers[inside]
        probability = probability[inside] / probability[inside].sum()
        log_weights = tempered(probability.log(), min(LEARNED_FROM, len(numbers) / 2))
        weights, leading = log_weights.exp()[:, None], whitening.leading
        mean = (weights * white).sum(0)
        centred = (white - mean)[:, :leading]
        effective = float(1 / weights.square().sum())
        # Few points hardly vary in some directions by chance; the prior's covariance is added.
        known = effective / (effective + leading + 1)
        anyhow = torch.eye(leading, dtype=white.dtype, device=white.device)
        covariance = known * (weights * centred).T @ centred + (1 - known) * anyhow
        variances, vectors = torch.linalg.eigh(covariance)
        informed = (variances < INFORMED) | (mean[:leading] @ vectors).square().gt(1 - INFORMED)
        vectors = vectors[:, informed]
        directions = white.new_zeros(white.shape[-1], vectors.shape[-1])
        directions[:leading] = vectors
        dims = vectors.shape[-1]  # Silverman's rule
        width = min(1.0, (4 / (effective * (dims + 2))) ** (1 / (dims + 4)))
        centres = mean @ directions + math.sqrt(1 - width**2) * (centred @ vectors)
        some = torch.arange(len(numbers), device=numbers.device)
        if len(some) > CENTRES:
            drawn = torch.multinomial(log_weights.exp(), CENTRES, replacement=True)
            some, often = drawn.unique(return_counts=True)
            log_weights = (often.to(log_weights) / CENTRES).log()
        return cls(
            whitening,
            points.chosen(some),
            numbers[some],
            log_weights,
            directions,
            centres[some],
            width * variances[informed].sqrt(),
        )

    def draw(self, number: int) -> dict[str, Tensor]:
        """Draw values ``[number, ...]``, with the global random state."""
        centre = torch.multinomial(self.log_weights.exp(), number, replacement=True)
        white, noise = (
            torch.randn(number, size).to(self.centres) for size in self.directions.shape
        )
        near = self.centres[centre] + noise * self.spread
        white = white + (near - white @ self.directions) @ self.directions.T
        values = self.whitening.values(white, self.points)
        for site, support in self.whitening.coordinates.supports.items():
            anyhow = torch.rand(number, device=support.device) < ANYHOW
            other = support[torch.randint(len(support), (number,), device=support.device)]
            values[site] = torch.where(anyhow, other, self.points[site][centre])
        return values

    def log_density(self, values: Mapping[str, Tensor], numbers: Tensor) -> Tensor:
        """Log density ``[M]`` of values ``[M, ...]`` without their own kernels.

        Args:
            values: of points.
            numbers: of the points among all that were ever drawn ``[M]``.
        """
        white = self.whitening.whiten(values)
        own = white @ self.directions
        found = -torch.cdist(own / self.spread, self.centres / self.spread).square() / 2  # [M, n]
        for site, support in self.whitening.coordinates.supports.items():
            same = values[site][:, None] == self.points[site]
            found = found + (ANYHOW / len(support) + (1 - ANYHOW) * same.double()).log()
        own_kernel = numbers[:, None] == self.numbers
        weights = self.log_weights.expand(own_kernel.shape).masked_fill(own_kernel, -torch.inf)
        # Of a single kernel nothing is left.
        weights = weights.log_softmax(-1)
        weights = weights.masked_fill(weights.isnan(), -torch.inf)
        near = (found + weights).logsumexp(-1) - self.spread.log().sum()
        others = (own.square().sum(-1) - white.square().sum(-1)) / 2
        constant = white.shape[-1] * math.log(2 * math.pi) / 2
        found = near + others - constant + self.whitening.log_abs_det(values)
        return found.masked_fill(found.isnan(), -torch.inf)  # at the boundary


@torch.no_grad()
def with_points_near(
    builder: ViewTableBuilder,
    found: Weighted,
    rounds: Sequence[Rounds],
    screening: Screening | None,
    options: ImportanceOptions,
) -> tuple[ViewTableBuilder, Weighted]:
    """Add points near the posterior until enough are effective (global random state).

    Args:
        builder: views of one person's rounds under points from the prior.
        found: weighted draws given these; few are enough.
        rounds: all rounds of the person.
        screening: when to drop points.
        options: settings of importance sampling.

    Returns:
        Views and weighted draws of the last stage. Their Pareto k is the larger one of those of
        draws and of points.
    """
    human, device = builder.human, builder.alive.device
    prior = PriorPoints.of(human)
    whitening = Whitening.of(Coordinates.of(human, builder.grid), builder.grid)
    drawn = from_prior = builder.grid.number
    numbers, kernels = torch.arange(drawn, device=device), []
    near_prior = round(FROM_PRIOR * NEW_POINTS)
    for _ in range(STAGES):
        points, probability = found.combination_probabilities()
        if 1 / float(probability.square().sum()) >= min(ENOUGH, options.enough):
            break
        own = Kernels.around(whitening, builder.grid.chosen(points), numbers[points], probability)
        kernels.append(own)
        order = probability.argsort(descending=True)
        most = points[order[probability[order].cumsum(0) - probability[order] < 1 - NEGLIGIBLE]]
        parts = (
            builder.grid.chosen(most),
            prior.values(near_prior, int(torch.randint(2**31, ()))),
            own.draw(NEW_POINTS - near_prior),
        )
        values = {site: torch.cat([part[site] for part in parts]) for site in builder.grid}
        new = torch.arange(drawn, drawn + NEW_POINTS, device=device)
        numbers = torch.cat([numbers[most], new])
        drawn, from_prior = drawn + NEW_POINTS, from_prior + near_prior
        each = [math.log(from_prior) + prior.log_density(values).double()]
        each += [
            math.log(NEW_POINTS - near_prior) + one.log_density(values, numbers) for one in kernels
        ]
        density = torch.stack(each).logsumexp(0).to(prior.like)
        grid = Grid(values, log_proposal=density, read=builder.grid.read)
        builder = ViewTableBuilder(human, screening, grid=grid)
        for some in rounds:
            builder.add(some)
        found = sample_importance(human, builder.table(), coarse(options), found)
    found = sample_importance(human, builder.table(), options, found)
    points, probability = found.combination_probabilities()
    # Weights of points from the prior are likelihoods, which are bounded.
    bounded = prior.is_prior and not kernels
    of_points = -math.inf if bounded else pareto_smoothed(probability.log())[1]
    return builder, replace(
        found,
        pareto_k=max(found.pareto_k, of_points),
        points=1 / float(probability.square().sum()),
    )

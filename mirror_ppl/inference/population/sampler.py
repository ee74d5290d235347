"""Gibbs sampling of `Pooling.program`: draws of a population, given draws of its people.

Two blocks alternate. Given the population, each person is assigned one of their own draws,

    s_p ~ p(psi_p^s | population) / p(psi_p^s | own prior)

and given those, sites are independent. The spread or concentration of each is drawn on a grid, with
the site's other parameters integrated out; the rest is conjugate::

    n people with values x of mean x' of a continuous site, its prior's mean 0 and width 1
        spread ~ p(spread) N(x; 0, spread^2 I + 1 1')     mean ~ N(n x' / (n + spread^2), ...)
    n people of whom k have each value of a discrete site
        concentration ~ p(concentration) DirichletMultinomial(k; concentration p_d)
        probabilities ~ Dirichlet(concentration p_d + k)

This is exact except for the grid, whose cells are a fortieth of the prior's standard deviation, and
which ends eight standard deviations below and above the median.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Dirichlet, Normal

from mirror_ppl.randomness import forked, seed_everything

WARMUP = 300
"""Discarded sweeps."""
THIN = 5
"""Sweeps per stored draw."""
CELLS, RANGE = 640, 8.0
"""Cells of the grid of a logarithm, and its half-width in standard deviations of the prior."""
SMALLEST = 1e-30
"""Least probability, since its logarithm has to be finite."""


@dataclass(frozen=True)
class HyperPriors:
    """Hyper-priors of concentrations and spreads.

    Attributes:
        probabilities: prior probabilities of each discrete site's values ``[n]``, by site.
        concentration_width: standard deviation of the logarithm of a concentration, whose median
            is the number of values.
        spread: median of a continuous site's spread, in standard deviations of its prior.
        spread_width: standard deviation of its logarithm.
    """

    probabilities: dict[str, Tensor]
    concentration_width: float
    spread: float
    spread_width: float


@dataclass(frozen=True)
class PeoplesDraws:
    """Draws of each person under the human model's own prior.

    Attributes:
        known: values of discrete sites in each draw, by site, one-hot ``[P, S, n]``.
        place: continuous sites, standardized by their prior, ``[P, S, C]``.
        log_prior: log prior of these sites under the human model, ``[P, S]``.
    """

    known: dict[str, Tensor]
    place: Tensor
    log_prior: Tensor


@torch.no_grad()
def sample_population(
    people: PeoplesDraws,
    priors: HyperPriors,
    number: int,
    seed: int,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Draw the population: probabilities ``[N, n]`` by site, means and spreads ``[N, C]``.

    Args:
        people: draws of the people.
        priors: hyper-priors.
        number: number of draws N.
        seed: seed of all random draws.
        report: called with the number of sweeps.
    """
    place = people.place.double()
    known = [people.known[name].double() for name in priors.probabilities]
    # A draw's log-density is linear in these, [P, S, F].
    features = torch.cat([place, place.square(), *known], -1)
    log_prior = people.log_prior.double()
    sites = {
        name: DiscreteSite(len(place), prior.double(), priors.concentration_width)
        for name, prior in priors.probabilities.items()
    }
    which = {name: people.known[name].argmax(-1) for name in sites}
    continuous = ContinuousSites(len(place), priors, place)
    everybody = torch.arange(len(place), device=place.device)
    kept: list[tuple[dict[str, Tensor], Tensor, Tensor]] = []
    total = WARMUP + THIN * number
    report(0, total)
    with forked():
        seed_everything(seed)
        weights = torch.ones_like(log_prior)
        for sweep in range(total):
            own = torch.multinomial(weights, 1)[:, 0]
            mean, spread = continuous.draw(place[everybody, own])
            probabilities = {
                name: site.draw(which[name][everybody, own]) for name, site in sites.items()
            }
            linear = torch.cat(
                [mean / spread**2, -0.5 / spread**2, *map(torch.log, probabilities.values())]
            )
            weights = torch.softmax(features @ linear - log_prior, -1)
            if sweep >= WARMUP and (sweep - WARMUP) % THIN == THIN - 1:
                kept.append((probabilities, mean, spread))
            report(sweep + 1, total)
    return (
        {name: torch.stack([one[0][name] for one in kept]).to(people.place) for name in sites},
        torch.stack([one[1] for one in kept]).to(people.place),
        torch.stack([one[2] for one in kept]).to(people.place),
    )


def _grid(median: Tensor | float, width: float, like: Tensor) -> tuple[Tensor, Tensor]:
    """Grid ``[CELLS]`` of the logarithm of a log-normal, at cell centres, and log-densities."""
    deviations = torch.linspace(-RANGE, RANGE, CELLS, dtype=like.dtype, device=like.device)
    return torch.as_tensor(median).log() + width * deviations, -0.5 * deviations**2


def _from_grid(grid: Tensor, log_density: Tensor) -> Tensor:
    """Draw a number for each row ``[..., CELLS]``, uniform within the drawn cell."""
    cell = torch.multinomial(torch.softmax(log_density, -1), 1)[..., 0]
    inside = torch.rand(cell.shape, dtype=grid.dtype, device=grid.device) - 0.5
    return (grid[cell] + inside * (grid[1] - grid[0])).exp()


class ContinuousSites:
    """Conditional posterior of the population in C continuous sites, given P people's values.

    Args:
        people: number of people P.
        priors: hyper-priors.
        like: a tensor with the dtype and device to use.

    Attributes:
        grid: logarithms of spreads, ``[CELLS]``.
    """

    def __init__(self, people: int, priors: HyperPriors, like: Tensor) -> None:
        self.people = people
        self.grid, self.log_prior = _grid(priors.spread, priors.spread_width, like)
        self.squares = (2 * self.grid).exp()

    def log_densities(self, values: Tensor) -> Tensor:
        """Log densities of spreads ``[C, CELLS]`` given values ``[P, C]``; mean integrated out."""
        number, centre = self.people, values.mean(0)
        scatter = (values - centre).square().sum(0)[:, None]
        across = self.squares + number
        return self.log_prior - 0.5 * (
            (number - 1) * self.squares.log()
            + across.log()
            + scatter / self.squares
            + number * centre[:, None].square() / across
        )

    def mean(self, values: Tensor, spread: Tensor) -> Normal:
        """Conditional of the means ``[C]``, given values ``[P, C]`` and spreads ``[C]``."""
        precision = 1 + self.people / spread**2
        return Normal(self.people * values.mean(0) / spread**2 / precision, precision.rsqrt())

    def draw(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Draw means and spreads ``[C]``, given values ``[P, C]``."""
        spread = _from_grid(self.grid, self.log_densities(values))
        return self.mean(values, spread).sample(), spread


class DiscreteSite:
    """Conditional posterior of the population in a discrete site with n values.

    Args:
        people: number of people P.
        prior: probabilities of the values ``[n]`` under the human model.
        width: standard deviation of the logarithm of the concentration.

    Attributes:
        grid: logarithms of concentrations, ``[CELLS]``.
    """

    def __init__(self, people: int, prior: Tensor, width: float) -> None:
        self.prior = prior
        self.grid, log_prior = _grid(float(len(prior)), width, prior)
        concentration = self.grid.exp()
        self.alone = concentration[:, None] * prior  # [CELLS, n]
        self.constant = (
            log_prior
            + concentration.lgamma()
            - (concentration + people).lgamma()
            - self.alone.lgamma().sum(-1)
        )

    def log_densities(self, count: Tensor) -> Tensor:
        """Log densities of concentrations ``[CELLS]``, given counts of people by value ``[n]``."""
        return self.constant + (self.alone + count).lgamma().sum(-1)

    def probabilities(self, count: Tensor, concentration: Tensor) -> Dirichlet:
        """Conditional of the probabilities ``[n]`` of values, given counts ``[n]``."""
        return Dirichlet(concentration * self.prior + count)

    def draw(self, value: Tensor) -> Tensor:
        """Draw probabilities ``[n]`` of values, given people's values ``[P]``."""
        count = torch.bincount(value, minlength=len(self.prior)).to(self.prior)
        concentration = _from_grid(self.grid, self.log_densities(count))
        return self.probabilities(count, concentration).sample().clamp(min=SMALLEST)

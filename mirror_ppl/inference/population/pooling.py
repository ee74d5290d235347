"""Partial pooling: a hierarchical prior, inferred together with the people.

The population is a Pyro program above the human model. Every site with one number per person gets
hyper-parameters, unless its prior already depends on other sites (how soon each terminal is
noticed, given the person's mean over terminals) or it is knowledge of the world
(`WorldKnowledge.world_sites`). These, and weights of the residual, keep their prior::

    concentration_d ~ LogNormal(log(n_d), 1)            discrete site d with n_d values; large if
    probabilities_d ~ Dirichlet(concentration_d p_d)    the population is close to its prior p_d
    mean_c          ~ Normal(m_c, s_c)                  continuous site c, in unconstrained space,
    spread_c        ~ LogNormal(log(s_c / 2), 0.5)      whose prior has mean m_c and deviation s_c
    psi_p           ~ Categorical(probabilities_d), Normal(mean_c, spread_c)        person p
    actions_p       ~ the human model given psi_p

Given the population, people are independent, and each was already inferred under the human model's
own prior. With S draws of those posteriors, up to a constant::

    p(actions_p | population) = mean over s of  p(psi_p^s | population) / p(psi_p^s | own prior)

(Hogg, Myers and Bovy, *Inferring the eccentricity distribution*, 2010). The population is inferred
by Gibbs sampling (:mod:`mirror_ppl.inference.population.sampler`), and each person's draws are
resampled by the same weights. The draws of a person without rounds come from the prior, and after
reweighting from the population's predictive: round zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.inference.population.sampler import (
    HyperPriors,
    PeoplesDraws,
    sample_population,
)
from mirror_ppl.likelihood.densities import adds_to_prior, log_prob, whole_correction
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, sample_sites, scalar_sites, unconstrained, values_of
from mirror_ppl.models.world_knowledge import world_sites
from mirror_ppl.progress import Report, silent
from mirror_ppl.randomness import forked, seed_everything

POOLINGS = ("none", "partial")
MOST_DRAWS, ALL_DRAWS, LEAST_DRAWS = 1000, 20_000, 100
"""Draws from which a population is inferred: at most per person, at most in total, and at least
per person."""
PRIOR_DRAWS = 4000
LEAST_PROBABILITY = 1e-6
"""Prior probability of a value of a discrete site below which it counts as impossible."""
CONCENTRATION_WIDTH = 1.0
"""Standard deviation of the logarithm of the concentration."""
SPREAD, SPREAD_WIDTH = 0.5, 0.5
"""Log-normal prior of the spread of people: median, in standard deviations of the human model's
prior, and standard deviation of the logarithm."""

CANDIDATES = 64
"""Candidates from which a newcomer is resampled, if the program has factors and the like."""


@dataclass(frozen=True)
class Population:
    """Posterior of hyper-parameters, S draws.

    Attributes:
        probabilities: by discrete site, probabilities of its values ``[S, n]``.
        mean, spread: by continuous site, in unconstrained space, ``[S]``.
    """

    probabilities: dict[str, Tensor]
    mean: dict[str, Tensor]
    spread: dict[str, Tensor]

    def __len__(self) -> int:
        return len(next(iter([*self.probabilities.values(), *self.mean.values()])))

    def spaced(self, number: int) -> Population:
        """Select this many draws, evenly spaced; with repetitions if there are too few."""
        chosen = torch.linspace(0, len(self) - 1, number).round().long()
        return Population(
            *({name: value[chosen] for name, value in part.items()} for part in vars(self).values())
        )


@dataclass(frozen=True)
class Pooled:
    """Posterior of people under a population.

    Attributes:
        draws: ``[S, P, 1, ...]``, one for each draw of the population.
        effective: effective number ``[P]`` of each person's own draws, the median over draws of the
            population.
    """

    draws: Draws
    effective: Tensor


class Pooling:
    """Partial pooling of one human model.

    Args:
        human: the model of people.
    """

    def __init__(self, human: HumanModel) -> None:
        self.human = human
        parents = dependencies(human).prior
        with forked():
            seed_everything(0)
            nodes = sample_sites(human, 1, PRIOR_DRAWS)
        nodes = {
            name: node
            for name, node in nodes.items()
            if name not in world_sites(human) and not parents[name]
        }
        self.sites = {name: site for name, site in scalar_sites(human).items() if name in nodes}
        drawn = unconstrained(self.sites, values_of(nodes), PRIOR_DRAWS)
        self.centre, self.width = drawn.mean(0), drawn.std(0)
        self.supports, self.prior_probabilities = {}, {}
        for name, node in nodes.items():
            if node["fn"].has_enumerate_support and not node["fn"].event_dim:
                values = node["fn"].enumerate_support()
                probabilities = node["fn"].log_prob(values).exp().flatten(1).mean(1)
                possible = (
                    probabilities > LEAST_PROBABILITY
                )  # prior-impossible values stay impossible
                self.supports[name] = values.flatten(1)[possible, 0]
                self.prior_probabilities[name] = (
                    probabilities[possible] / probabilities[possible].sum()
                )

    def program(
        self, known: Mapping[str, Tensor], place: Mapping[str, Tensor], log_prior: Tensor
    ) -> None:
        """Pyro program of the population, conditioned on its people.

        Args:
            known: values of discrete sites in each draw, by site, one-hot ``[P, S, n]``.
            place: values of continuous sites in unconstrained space, by site, ``[P, S]``.
            log_prior: log prior of the draws under the human model, ``[P, S]``.
        """
        probabilities = {}
        for name, prior in self.prior_probabilities.items():
            size = prior.new_tensor(float(len(prior)))
            prior_of = dist.LogNormal(size.log(), torch.full_like(size, CONCENTRATION_WIDTH))
            concentration = pyro.sample(f"{name}_concentration", prior_of)
            probabilities[name] = pyro.sample(
                f"{name}_probabilities", dist.Dirichlet(concentration * prior)
            )
        mean, spread = {}, {}
        for name, centre, width in zip(self.sites, self.centre, self.width, strict=True):
            mean[name] = pyro.sample(f"{name}_mean", dist.Normal(centre, width))
            half = dist.LogNormal((SPREAD * width).log(), torch.full_like(width, SPREAD_WIDTH))
            spread[name] = pyro.sample(f"{name}_spread", half)
        ratio = self.log_density(probabilities, mean, spread, known, place) - log_prior
        with pyro.plate("person", len(log_prior)):
            pyro.factor("rounds", torch.logsumexp(ratio, -1) - math.log(ratio.shape[-1]))

    @staticmethod
    def log_density(
        probabilities: Mapping[str, Tensor],
        mean: Mapping[str, Tensor],
        spread: Mapping[str, Tensor],
        known: Mapping[str, Tensor],
        place: Mapping[str, Tensor],
    ) -> Tensor:
        """Log density ``[...]`` of people's sites in a population."""
        total = torch.zeros(())
        for name, value in place.items():
            total = total + dist.Normal(mean[name], spread[name]).log_prob(value)
        for name, value in known.items():
            total = total + value @ probabilities[name].log()
        return total

    def read(
        self, draws: Mapping[str, Tensor]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor], Tensor]:
        """Convert posterior draws ``[S, P, 1, ...]`` to the arguments of :meth:`program`."""
        known = {
            name: (draws[name][..., 0].T[..., None] == support).to(self.centre)
            for name, support in self.supports.items()
        }
        place = {name: site.inv(draws[name][..., 0].T) for name, site in self.sites.items()}
        return known, place, self._log_prior(draws)

    def _log_prior(self, draws: Mapping[str, Tensor]) -> Tensor:
        number, people = next(iter(draws.values())).shape[:2]
        nodes = sample_sites(self.human, people, number, draws)
        total = torch.zeros(number, people, device=self.centre.device)
        for name in (*self.supports, *self.sites):
            total = total + log_prob(nodes[name]).expand(number, people, 1)[..., 0]
        # In unconstrained space.
        place = unconstrained(self.sites, draws)
        stretch = place.new_zeros(len(place))
        for column, site in enumerate(self.sites.values()):
            at = place[:, column]
            stretch = stretch + site.log_abs_det_jacobian(at, site(at))
        return (total + stretch.view(number, people)).T

    def fit(
        self, draws: Mapping[str, Tensor], number: int, seed: int, report: Report = silent
    ) -> Population:
        """Infer the population from people's posterior draws ``[S, P, 1, ...]``.

        Args:
            draws: draws of each person under the human model's own prior.
            number: number of draws of the population.
            seed: seed of all random draws.
            report: called with the number of steps.
        """
        held, people = next(iter(draws.values())).shape[:2]
        used = min(held, MOST_DRAWS, max(LEAST_DRAWS, ALL_DRAWS // people))
        some = torch.linspace(0, held - 1, used).round().long()
        known, place, log_prior = self.read({name: value[some] for name, value in draws.items()})
        own = torch.stack([place[name] for name in self.sites], -1)
        probabilities, mean, spread = sample_population(
            PeoplesDraws(known, (own - self.centre) / self.width, log_prior),
            HyperPriors(self.prior_probabilities, CONCENTRATION_WIDTH, SPREAD, SPREAD_WIDTH),
            number,
            seed,
            lambda done, total: report("population", done, total, ""),
        )
        mean, spread = self.centre + self.width * mean, self.width * spread
        return Population(
            probabilities,
            dict(zip(self.sites, mean.unbind(-1), strict=True)),
            dict(zip(self.sites, spread.unbind(-1), strict=True)),
        )

    @torch.no_grad()
    def pooled(self, draws: Mapping[str, Tensor], population: Population, seed: int) -> Pooled:
        """Resample people's draws by the weights of a population.

        Args:
            draws: draws of each person under the human model's own prior, ``[S, P, 1, ...]``.
            population: posterior of the population.
            seed: seed of all random draws.
        """
        known, place, log_prior = self.read(draws)
        effective, chosen = [], []
        with forked():
            seed_everything(seed)
            for index in range(len(population)):
                probabilities, mean, spread = (
                    {name: value[index] for name, value in part.items()}
                    for part in vars(population).values()
                )
                density = self.log_density(probabilities, mean, spread, known, place)
                weights = torch.softmax(density - log_prior, -1)
                effective.append(1 / weights.square().sum(-1))
                chosen.append(torch.multinomial(weights, 1)[:, 0])
        rows = torch.stack(chosen)  # [S', P]
        people = torch.arange(rows.shape[1])
        own = {name: value[rows, people] for name, value in draws.items()}
        return Pooled(own, torch.stack(effective).median(0).values)

    @torch.no_grad()
    def newcomers(self, population: Population, people: int, seed: int) -> Draws:
        """Draw people without rounds from the population, ``[S, P, 1, ...]``.

        If ``prior`` has factors, observed sites, scales or masks, each person is resampled from
        several candidates by the density that they add.
        """
        number, tries = len(population), CANDIDATES if adds_to_prior(self.human) else 1
        with forked():
            seed_everything(seed)
            given: Draws = {}
            for name, support in self.supports.items():
                probabilities = population.probabilities[name][:, None].expand(
                    -1, people * tries, -1
                )
                given[name] = support[dist.Categorical(probabilities).sample()][..., None]
            for name, site in self.sites.items():
                normal = dist.Normal(population.mean[name], population.spread[name])
                given[name] = site(normal.sample(torch.Size([people * tries])).T)[..., None]
            drawn = values_of(sample_sites(self.human, people * tries, number, given))
            if tries == 1:
                return drawn
            # For these sites the population replaces the prior.
            said = whole_correction(self.human, drawn, people * tries, given)
            weights = torch.softmax(said.view(number * people, tries), -1)
            chosen = torch.multinomial(weights, 1).view(number, people)
        rows = torch.arange(people, device=chosen.device) * tries + chosen
        draw = torch.arange(number, device=chosen.device)[:, None]
        return {name: value[draw, rows] for name, value in drawn.items()}

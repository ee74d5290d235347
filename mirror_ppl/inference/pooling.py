"""Partial pooling: people are alike, and how alike is inferred with them.

The population is a Pyro program above the human model. Every site of one number a person gets
hyper-parameters; the others (weights of the residual) keep their prior::

    chances_d  ~ Dirichlet(1 .. 1)                        discrete site d, over its values
    mean_c     ~ Normal(m_c, s_c)                         continuous site c, in unconstrained space;
    spread_c   ~ LogNormal(log(s_c / 2), 0.5)             m_c, s_c: mean and width of its own prior
    psi_p      ~ Categorical(chances_d), Normal(mean_c, spread_c)        person p
    actions_p  ~ the human model given psi_p

Given the population, people do not depend on each other, and each was inferred already under the
human model's own prior. So with S draws of those posteriors, up to a constant::

    p(actions_p | population) = mean over s of  p(psi_p^s | population) / p(psi_p^s | own prior)

(Hogg, Myers and Bovy, *Inferring the eccentricity distribution*, 2010). The population is inferred
by Hamiltonian Monte Carlo, and people are drawn anew by the same weights. Somebody without rounds
has draws of the prior, weights that only tell of the population, and so its predictive: round zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.inference.importance import places, scalar_sites
from mirror_ppl.inference.nuts import run_chain
from mirror_ppl.inference.prior import Draws, draw_prior, sample_sites, values_of
from mirror_ppl.inference.svi import Report, silent
from mirror_ppl.models.human import HumanModel

PRIOR_DRAWS = 4000


@dataclass(frozen=True)
class Population:
    """Posterior of hyper-parameters, S draws.

    Attributes:
        chances: by discrete site, probabilities of its values ``[S, n]``.
        mean, spread: of the continuous sites in unconstrained space ``[S, D]``.
    """

    chances: dict[str, Tensor]
    mean: Tensor
    spread: Tensor

    def __len__(self) -> int:
        return len(self.mean)


class Pooling:
    """Partial pooling of one human model.

    Args:
        human: the model of people; the priors of its sites must not depend on each other.
    """

    def __init__(self, human: HumanModel) -> None:
        self.human = human
        self.sites = scalar_sites(human)
        nodes = sample_sites(human, 1)
        self.supports = {
            name: node["fn"].enumerate_support(expand=False).flatten()
            for name, node in nodes.items()
            if node["fn"].has_enumerate_support
        }
        drawn = places(self.sites, draw_prior(human, 1, PRIOR_DRAWS, 0))
        self.centre, self.width = drawn.mean(0), drawn.std(0)

    def program(self, known: Mapping[str, Tensor], place: Tensor, log_prior: Tensor) -> None:
        """The population and what is known of its people.

        Args:
            known: by discrete site, which of its values each draw has, ``[P, S]``.
            place: continuous sites of the draws in unconstrained space, ``[P, S, D]``.
            log_prior: of the draws under the human model, ``[P, S]``.
        """
        chances = {
            name: pyro.sample(f"{name}_chances", dist.Dirichlet(torch.ones(len(support))))
            for name, support in self.supports.items()
        }
        mean = pyro.sample("mean", dist.Normal(self.centre, self.width).to_event(1))
        spread = pyro.sample(
            "spread", dist.LogNormal((self.width / 2).log(), self.width.new_tensor(0.5)).to_event(1)
        )
        ratio = self.log_density(chances, mean, spread, known, place) - log_prior
        with pyro.plate("person", len(place)):
            pyro.factor("rounds", torch.logsumexp(ratio, -1) - math.log(ratio.shape[-1]))

    @staticmethod
    def log_density(
        chances: Mapping[str, Tensor],
        mean: Tensor,
        spread: Tensor,
        known: Mapping[str, Tensor],
        place: Tensor,
    ) -> Tensor:
        """Log density ``[...]`` of people's sites in a population."""
        total = dist.Normal(mean, spread).log_prob(place).sum(-1)
        for name, value in known.items():
            total = total + chances[name].log()[value]
        return total

    def read(self, draws: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """What :meth:`program` is given, of posterior draws ``[S, P, 1, ...]``."""
        number, people = next(iter(draws.values())).shape[:2]
        known = {
            name: (draws[name][..., 0].T[..., None] == support).long().argmax(-1)
            for name, support in self.supports.items()
        }
        place = places(self.sites, draws).view(number, people, -1).transpose(0, 1)
        return known, place, self._log_prior(draws)

    def _log_prior(self, draws: Mapping[str, Tensor]) -> Tensor:
        number, people = next(iter(draws.values())).shape[:2]
        nodes = sample_sites(self.human, people, number, draws)
        total = torch.zeros(number, people)
        for name in (*self.supports, *self.sites):
            value = nodes[name]["value"]
            total = total + nodes[name]["fn"].log_prob(value).expand(number, people, 1)[..., 0]
        # In unconstrained space.
        place = places(self.sites, draws)
        stretch = torch.zeros(len(place))
        for column, site in enumerate(self.sites.values()):
            at = place[:, column]
            stretch = stretch + site.log_abs_det_jacobian(at, site(at))
        return (total + stretch.view(number, people)).T

    def fit(
        self, draws: Mapping[str, Tensor], number: int, seed: int, report: Report = silent
    ) -> Population:
        """The population that people with these posterior draws ``[S, P, 1, ...]`` are from.

        Args:
            draws: of each person under the human model's own prior.
            number: of draws of the population.
            seed: of everything random.
            report: told of steps.
        """
        found = run_chain(self.program, self.read(draws), number, seed, "population", report)
        chances = {name: found[f"{name}_chances"] for name in self.supports}
        return Population(chances, found["mean"], found["spread"])

    def pooled(self, draws: Mapping[str, Tensor], population: Population, seed: int) -> Draws:
        """Draws ``[S', P, 1, ...]`` of people who are from a population, one for each of its draws.

        Args:
            draws: of each person under the human model's own prior, ``[S, P, 1, ...]``.
            population: what is known of it.
            seed: of everything random.
        """
        known, place, log_prior = self.read(draws)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            chosen = []
            for index in range(len(population)):
                chances = {name: value[index] for name, value in population.chances.items()}
                density = self.log_density(
                    chances, population.mean[index], population.spread[index], known, place
                )
                weights = torch.softmax(density - log_prior, -1)
                chosen.append(torch.multinomial(weights, 1)[:, 0])
        rows = torch.stack(chosen)  # [S', P]
        people = torch.arange(rows.shape[1])
        return {name: value[rows, people] for name, value in draws.items()}

    def newcomers(self, population: Population, people: int, seed: int) -> Draws:
        """Draws ``[S, P, 1, ...]`` of people of whom nothing is known but where they are from."""
        number = len(population)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            given: Draws = {}
            for name, support in self.supports.items():
                chances = population.chances[name][:, None].expand(-1, people, -1)
                given[name] = support[dist.Categorical(chances).sample()][..., None]
            mean = population.mean[:, None].expand(-1, people, -1)
            place = dist.Normal(mean, population.spread[:, None]).sample()
            for column, (name, site) in enumerate(self.sites.items()):
                given[name] = site(place[..., column])[..., None]
            return values_of(sample_sites(self.human, people, number, given))

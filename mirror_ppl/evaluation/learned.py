"""Results of learners: they predict rounds, and may stand for people in a communicator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from mirror_ppl.baselines import NetworkPerson, PooledLogistic, RecurrentNetworks
from mirror_ppl.communication.person import Person
from mirror_ppl.data import Demonstrations
from mirror_ppl.domains.base import Domain
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.inference.results.summary import predictive
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.self_model import SelfModel

NETWORK_DRAWS = 16
"""Most draws to plan with, of networks that take turns: draws of one network differ in sampled
actions alone. To a network any message is informative, so that it has many candidates and planning
with it takes longest."""


class Learned(Protocol):
    """Result of a learner, for P people."""

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """Log-probabilities of actions in their rounds, ``[P, B, T, A]``."""
        ...


class Plannable(Learned, Protocol):
    """Result of a learner with which messages can be planned."""

    def person(self, number: int, draws: int) -> Person:
        """Return one of the people, with at most ``draws`` draws."""
        ...


@dataclass(frozen=True)
class Posterior:
    """A human model with posterior draws ``[S, P, 1, ...]`` of implants."""

    human: HumanModel
    draws: Mapping[str, Tensor]

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """Log of the mean probabilities over draws."""
        return predictive(predict_rounds(self.human, rounds, self.draws))

    def person(self, number: int, draws: int) -> Person:
        """Return one of the people, with evenly spaced posterior draws."""
        first = next(iter(self.draws.values()))
        some = torch.linspace(0, len(first) - 1, min(draws, len(first))).long()
        own = {name: value[some, number : number + 1] for name, value in self.draws.items()}
        return Person(self.human, own)


@dataclass(frozen=True)
class Trained:
    """Networks of P people.

    Attributes:
        ensemble: their networks, from each of E initializations.
        self_model: the robot's, for its knowledge of the world.
        setting: the setting, which limits unaided sight.
        world: in which the robot plans, with inferred rewards.
    """

    ensemble: tuple[RecurrentNetworks, ...]
    self_model: SelfModel
    setting: str
    world: Domain

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """Log of the mean probabilities over each person's networks."""
        each = [networks.log_probabilities(rounds) for networks in self.ensemble]
        return torch.stack(each).logsumexp(0) - math.log(len(each))

    def person(self, number: int, draws: int) -> Person:
        """Return one of the people, whose networks are equally probable."""
        human = NetworkPerson(
            self.self_model,
            RecurrentNetworks.ensemble(self.ensemble, number),
            self.setting,
            self.world,
        )
        return Person(human, human.draws(min(draws, NETWORK_DRAWS)))


@dataclass(frozen=True)
class Regressed:
    """Pooled logistic regression of P people."""

    model: PooledLogistic

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """Log-probabilities by each person's weights."""
        return self.model.log_probabilities(rounds)


@dataclass(frozen=True)
class BaseRates:
    """Frequencies of P people's actions, whatever the state: ``[P, A]``."""

    shares: Tensor

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """Log-frequencies, the same at every step."""
        return self.shares.log()[:, None, None].expand(*rounds.shape, -1)

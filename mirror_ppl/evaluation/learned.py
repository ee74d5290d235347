"""What was learned of people: it predicts rounds, and may stand for them in a communicator."""

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

SAME_DRAWS = 16
"""Most draws that are planned with where all are the same: they differ in chance alone, of which
each has several courses. To a network whatever is told is something new, so that its messages are
many and planning with it takes longest."""


class Learned(Protocol):
    """What was learned of P people."""

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """Log-probabilities of actions in rounds of theirs, ``[P, B, T, A]``."""
        ...


class Plannable(Learned, Protocol):
    """What was learned, with which messages can be planned."""

    def person(self, number: int, draws: int) -> Person:
        """One of the people, with so many draws."""
        ...


@dataclass(frozen=True)
class Posterior:
    """A human model with posterior draws ``[S, P, 1, ...]`` of implants."""

    human: HumanModel
    draws: Mapping[str, Tensor]

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """Of the mean over draws."""
        return predictive(predict_rounds(self.human, rounds, self.draws))

    def person(self, number: int, draws: int) -> Person:
        """Draws from all over the posterior."""
        first = next(iter(self.draws.values()))
        some = torch.linspace(0, len(first) - 1, min(draws, len(first))).long()
        own = {name: value[some, number : number + 1] for name, value in self.draws.items()}
        return Person(self.human, own)


@dataclass(frozen=True)
class Trained:
    """Networks of P people.

    Attributes:
        ensemble: theirs, from each of E beginnings.
        self_model: the robot's, for what it knows of the world.
        setting: which lets people see what they see by themselves.
        world: in which the robot plans, with what it learned of rewards.
    """

    ensemble: tuple[RecurrentNetworks, ...]
    self_model: SelfModel
    setting: str
    world: Domain

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """Of the mean over each person's networks."""
        each = [networks.log_probabilities(rounds) for networks in self.ensemble]
        return torch.stack(each).logsumexp(0) - math.log(len(each))

    def person(self, number: int, draws: int) -> Person:
        """One of the people, each of whose networks is as probable."""
        human = NetworkPerson(
            self.self_model,
            RecurrentNetworks.ensemble(self.ensemble, number),
            self.setting,
            self.world,
        )
        return Person(human, human.draws(min(draws, SAME_DRAWS)))


@dataclass(frozen=True)
class Regressed:
    """Pooled logistic regression of P people."""

    model: PooledLogistic

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """Of each person's weights."""
        return self.model.log_probabilities(rounds)


@dataclass(frozen=True)
class BaseRates:
    """How often P people did each thing, whatever the state: ``[P, A]``."""

    shares: Tensor

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """The same at every step."""
        return self.shares.log()[:, None, None].expand(*rounds.shape, -1)

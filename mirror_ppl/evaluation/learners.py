"""Models of people that are compared: one interface for MIRROR, its parts, and its baselines.

A learner gets rounds of people and their robot's self-model. What it learned predicts other rounds
of the same people and, if it can be planned with, stands for a person in a communicator.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Protocol

import torch
from torch import Tensor

from mirror_ppl.baselines import (
    BehaviourCloneOptions,
    NetworkPerson,
    PooledLogistic,
    RecurrentNetworks,
    SoftQOptions,
    fit_behaviour_clone,
    fit_pooled_logistic,
    fit_soft_q,
)
from mirror_ppl.baselines.inputs import Sight
from mirror_ppl.communication.person import Person
from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import DOMAINS
from mirror_ppl.domains.base import Domain
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.evaluation.assistance import Listener, listeners
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.population.pooling import Population
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.inference.results.summary import predictive
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.models.world_knowledge import fit_world, planning_domain
from mirror_ppl.people import simulate, simulated_people
from mirror_ppl.training.guide_file import network_for

TRAINING = 20
"""Rounds that there are to learn from, the first ones."""
VALIDATION, TEST = slice(20, 30), slice(30, 36)
"""Rounds by which baselines stop their training, and held-out ones, as in the supplement."""
RECORDED = 36
OTHERS = 100_000
"""Seed of the others from whom a population is learned."""


@dataclass(frozen=True)
class Group:
    """Simulated people in whom learners are tried.

    Attributes:
        domain: the world.
        setting: its setting.
        population: of whom there are more.
        people: how many, P.
        seed: of the people and their rounds.
        told: chance that an item that can be communicated is told, at each step of their rounds.
    """

    domain: str
    setting: str
    population: str
    people: int
    seed: int
    told: float = 0.0

    def __str__(self) -> str:
        return f"{self.domain}, {self.setting}, seed {self.seed}"

    @lru_cache(maxsize=4)  # noqa: B019 - groups are values
    def recordings(self, rounds: int = RECORDED) -> Demonstrations:
        """Rounds of these people."""
        return simulate(
            self.domain,
            self.setting,
            self.population,
            self.people,
            rounds,
            self.seed,
            told=self.told,
        )

    def listeners(self, rounds: int) -> list[Listener]:
        """These people, and other rounds of theirs in which they can be spoken to."""
        everybody = simulated_people(
            self.domain, self.setting, self.population, self.people, self.seed
        )
        return listeners(everybody, self.people, self.setting, rounds, self.seed)

    @property
    def self_model(self) -> SelfModel:
        """The robot's, as it ships."""
        return load_self_model(shipped_weights(self.domain), self.domain)[0]


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
        networks: theirs.
        self_model: the robot's, for what it knows of the world.
        setting: which lets people see what they see by themselves.
        world: in which the robot plans, with what it learned of rewards.
    """

    networks: RecurrentNetworks
    self_model: SelfModel
    setting: str
    world: Domain

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """Of each person's network."""
        return self.networks.log_probabilities(rounds)

    def person(self, number: int, draws: int) -> Person:
        """One of the networks; all draws are the same, so a few do."""
        own = self.networks.only(number)
        human = NetworkPerson(self.self_model, own, self.setting, self.world)
        return Person(human, human.draws(min(draws, SAME_DRAWS)))


@dataclass(frozen=True)
class Regressed:
    """Pooled logistic regression of P people."""

    model: PooledLogistic

    def log_predictive(self, rounds: Demonstrations) -> Tensor:
        """Of each person's weights."""
        return self.model.log_probabilities(rounds)


Learn = Callable[[Group, int, int], Learned]
"""Learns of a group from their first rounds, at least 1; and with a seed of everything random."""


def _mirror(
    variant: str | None = None, engine: str = "importance", from_others: bool = False
) -> Learn:
    def learn(group: Group, rounds: int, seed: int) -> Posterior:
        human = load_human_model(variant, group.self_model)
        train = group.recordings().select_rounds(slice(rounds))
        fit_world(human, train)
        network = network_for(engine, None, human)
        population = population_of(replace(group, seed=OTHERS)) if from_others else None
        options = InferenceOptions(engine)
        found = infer(human, train, options, seed, network, population=population)
        return Posterior(human, found.draws)

    return learn


@cache
def population_of(group: Group) -> Population:
    """The population that a group is from, as far as all their training rounds tell."""
    human = load_human_model(None, group.self_model)
    rounds = group.recordings(TRAINING)
    fit_world(human, rounds)
    found = infer(human, rounds, InferenceOptions(pooling="partial"), group.seed)
    assert found.population is not None
    return found.population


def _parts(group: Group, rounds: int) -> tuple[Demonstrations, Demonstrations]:
    recordings = group.recordings()
    return recordings.select_rounds(slice(rounds)), recordings.select_rounds(VALIDATION)


def _trained(group: Group, train: Demonstrations, networks: RecurrentNetworks) -> Trained:
    # What rewards say of the world is nothing about people, so baselines get to know it, too.
    human = load_human_model(None, group.self_model)
    fit_world(human, train)
    return Trained(networks, human.self_model, group.setting, planning_domain(human, {}))


def _behaviour_cloning(sight: Sight) -> Learn:
    def learn(group: Group, rounds: int, seed: int) -> Trained:
        parts = _parts(group, rounds)
        networks = fit_behaviour_clone(
            *parts, BehaviourCloneOptions.of(group.domain, sight=sight), seed
        )
        return _trained(group, parts[0], networks)

    return learn


def _sqil(sight: Sight) -> Learn:
    def learn(group: Group, rounds: int, seed: int) -> Trained:
        parts = _parts(group, rounds)
        return _trained(
            group, parts[0], fit_soft_q(*parts, SoftQOptions.of(group.domain, sight=sight), seed)
        )

    return learn


def _logistic(group: Group, rounds: int, seed: int) -> Regressed:
    del seed
    return Regressed(fit_pooled_logistic(*_parts(group, rounds)))


LEARNERS: dict[str, Learn] = {
    "mirror": _mirror(),
    "mirror-amortized": _mirror(engine="amortized"),
    "mirror-svi": _mirror(engine="svi"),
    "mirror-nuts": _mirror(engine="nuts"),
    "mirror-population": _mirror(from_others=True),
    "perceptual-only": _mirror("perceptual-only"),
    "policy-only": _mirror("policy-only"),
    "no-implants": _mirror("no-implants"),
    "bc": _behaviour_cloning("setting"),
    "bc-everything": _behaviour_cloning("everything"),
    "sqil": _sqil("setting"),
    "sqil-everything": _sqil("everything"),
    "logistic": _logistic,
}
"""Everything that can be compared, in the order in which it is shown. Guides are `exact` but for
those of other names; ``mirror-population`` has a prior learned from others.
Baselines get what the setting lets people see, which MIRROR has to find out, but for those that
read ``everything``, as the human model is given it."""
SLOW = {
    "mirror-nuts": DOMAINS,
    "mirror-svi": ("bomb_defusal",),
    "sqil-everything": ("search_rescue", "bomb_defusal"),
}
"""Of these what is compared on request only, and where: a chain of each person takes minutes, `svi`
sums over all rules of a bomb at each of its steps, and SQIL learns from long rounds for minutes."""
SAME_DRAWS = 16
"""Most draws that are planned with where all are the same: they differ in chance alone, of which
each has several courses. To a network whatever is told is something new, so that its messages are
many and planning with it takes longest."""
PLANNABLE = ("mirror", "bc", "sqil")
"""Of these what drives a communicator in the comparison of assistance."""


def is_own(name: str) -> bool:
    """Whether it names a human model in a file, ``path/to/file.py:Class``."""
    return ".py:" in name


def learn(name: str, group: Group, rounds: int, seed: int) -> Learned:
    """What a learner makes of the first rounds of a group.

    Args:
        name: in ``LEARNERS``, or ``path/to/file.py:Class``, a human model of somebody's own, with
            the engine ``importance``.
        group: the people.
        rounds: how many are learned from.
        seed: of everything random.

    Raises:
        UnknownNameError: there is no such learner.
        HumanModelError: there is no such human model.
        AssetError: no trained guide ships for that domain.
    """
    if is_own(name):
        return _mirror(name)(group, rounds, seed)
    if name not in LEARNERS:
        raise UnknownNameError.of("model", name, tuple(LEARNERS))
    return LEARNERS[name](group, rounds, seed)

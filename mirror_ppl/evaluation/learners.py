"""Learners: one interface for MIRROR, its ablations and its baselines.

A learner gets rounds of people and the robot's self-model. Its result predicts other rounds of the
same people and, if messages can be planned with it, stands for a person in a communicator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any

import torch

from mirror_ppl.baselines import (
    BehaviourCloneOptions,
    RecurrentNetworks,
    SoftQOptions,
    as_one_person,
    fit_behaviour_clone,
    fit_pooled_logistic,
    fit_soft_q,
)
from mirror_ppl.baselines.inputs import INFORMED, Sight
from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.evaluation.assistance import Listener, listeners
from mirror_ppl.evaluation.known_sight import known_sight
from mirror_ppl.evaluation.learned import BaseRates, Learned, Posterior, Regressed, Trained
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.population.pooling import Population
from mirror_ppl.inference.results.criticism import action_shares
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.models.world_knowledge import fit_world, planning_domain
from mirror_ppl.people import simulate, simulated_people
from mirror_ppl.training.guide_file import network_for

TRAINING = 20
"""Number of training rounds, the first ones."""
VALIDATION, TEST = slice(20, 30), slice(30, 36)
"""Validation rounds of baselines, and held-out rounds, as in the supplement."""
RECORDED = 36
OTHERS = 100_000
"""Seed of the other people from whom a population is learned."""
EACH = 1_000_000
"""Distance between the seeds of an ensemble's networks."""
Fit = Callable[..., RecurrentNetworks]
OptionsOf = Callable[..., Any]


@dataclass(frozen=True)
class Group:
    """Simulated people on whom learners are evaluated.

    Attributes:
        domain: the world.
        setting: its setting.
        population: from which the people are drawn.
        people: number of people, P.
        seed: of the people and their rounds.
        told: probability that a communicable item is communicated, at each step of their rounds.
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
        """Simulate rounds of these people."""
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
        """Return these people with other rounds, to be played with messages."""
        everybody = simulated_people(
            self.domain, self.setting, self.population, self.people, self.seed
        )
        return listeners(everybody, self.people, self.setting, rounds, self.seed)

    @property
    def self_model(self) -> SelfModel:
        """The robot's self-model, as it ships."""
        return load_self_model(shipped_weights(self.domain), self.domain)[0]


Learn = Callable[[Group, int, int, int], Learned]
"""Learns from a group's first rounds: arguments are the group, the number of rounds, a seed of
everything random, and the number of networks of each person."""


def _mirror(
    variant: str | None = None,
    engine: str = "importance",
    from_others: bool = False,
    pooling: str = "none",
) -> Learn:
    def learn(group: Group, rounds: int, seed: int, members: int) -> Posterior:
        del members
        human = load_human_model(variant, group.self_model)
        train = group.recordings().select_rounds(slice(rounds))
        fit_world(human, train)
        network = network_for(engine, None, human)
        population = population_of(replace(group, seed=OTHERS)) if from_others else None
        options = InferenceOptions(engine, pooling=pooling if rounds else "none")
        found = infer(human, train, options, seed, network, population=population)
        return Posterior(human, found.draws)

    return learn


def _known_sight(group: Group, rounds: int, seed: int, members: int) -> Posterior:
    """Infer each person's policy implants, given their true perceptual implants."""
    del members
    train, each = group.recordings().select_rounds(slice(rounds)), []
    for person in train.people:
        own = train.select_people([person])
        human = known_sight(group.self_model, own)
        each.append(infer(human, own, InferenceOptions("importance"), seed).draws)
    draws = {name: torch.cat([one[name] for one in each], 1) for name in each[0]}
    return Posterior(HumanModel(group.self_model), draws)


@cache
def population_of(group: Group) -> Population:
    """Infer the population of a group from all their training rounds."""
    human = load_human_model(None, group.self_model)
    rounds = group.recordings(TRAINING)
    fit_world(human, rounds)
    found = infer(human, rounds, InferenceOptions(pooling="partial"), group.seed)
    assert found.population is not None
    return found.population


def _parts(group: Group, rounds: int) -> tuple[Demonstrations, Demonstrations]:
    recordings = group.recordings()
    return recordings.select_rounds(slice(rounds)), recordings.select_rounds(VALIDATION)


def _trained(
    group: Group, train: Demonstrations, ensemble: tuple[RecurrentNetworks, ...]
) -> Trained:
    # World parameters inferred from rewards say nothing about people, so baselines get them, too.
    human = load_human_model(None, group.self_model)
    fit_world(human, train)
    return Trained(ensemble, human.self_model, group.setting, planning_domain(human, {}))


def _networks(fit: Fit, options: OptionsOf, sight: Sight, pooled: bool = False) -> Learn:
    """Make a learner of recurrent networks, one for each person or, pooled, one for all."""

    def learn(group: Group, rounds: int, seed: int, members: int) -> Trained:
        train, validation = own = _parts(group, rounds)
        if pooled:
            own = (as_one_person(train), as_one_person(validation))
        settings = options(group.domain, sight=sight)
        # The first member of an ensemble has the group's seed.
        found = [fit(*own, settings, seed + EACH * member) for member in range(members)]
        if pooled:
            found = [networks.shared_by(train.people) for networks in found]
        return _trained(group, train, tuple(found))

    return learn


def _logistic(group: Group, rounds: int, seed: int, members: int) -> Regressed:
    del seed, members
    return Regressed(fit_pooled_logistic(*_parts(group, rounds)))


def _base_rate(group: Group, rounds: int, seed: int, members: int) -> BaseRates:
    del seed, members
    train = group.recordings().select_rounds(slice(rounds))
    return BaseRates(action_shares(train, len(get_domain(group.domain).actions)))


LEARNERS: dict[str, Learn] = {
    "mirror": _mirror(),
    "mirror-pooled": _mirror(pooling="partial"),
    "mirror-population": _mirror(from_others=True),
    "mirror-amortized": _mirror(engine="amortized"),
    "mirror-svi": _mirror(engine="svi"),
    "mirror-nuts": _mirror(engine="nuts"),
    "mirror-known-sight": _known_sight,
    "perceptual-only": _mirror("perceptual-only"),
    "policy-only": _mirror("policy-only"),
    "no-implants": _mirror("no-implants"),
    "bc": _networks(fit_behaviour_clone, BehaviourCloneOptions.of, "setting"),
    "bc-everything": _networks(fit_behaviour_clone, BehaviourCloneOptions.of, "everything"),
    "bc-informed": _networks(fit_behaviour_clone, BehaviourCloneOptions.of, INFORMED),
    "bc-pooled": _networks(fit_behaviour_clone, BehaviourCloneOptions.of, "setting", True),
    "bc-informed-pooled": _networks(fit_behaviour_clone, BehaviourCloneOptions.of, INFORMED, True),
    "sqil": _networks(fit_soft_q, SoftQOptions.of, "setting"),
    "sqil-everything": _networks(fit_soft_q, SoftQOptions.of, "everything"),
    "sqil-informed": _networks(fit_soft_q, SoftQOptions.of, INFORMED),
    "sqil-pooled": _networks(fit_soft_q, SoftQOptions.of, "setting", True),
    "logistic": _logistic,
    "base-rate": _base_rate,
}
"""Learners, in the order in which they are shown. The engine is ``importance`` unless the name has
another. ``mirror-pooled`` infers the population jointly with the people, ``mirror-population`` has
a prior learned from other people, ``mirror-known-sight`` is given the true sight. Baselines are
given what the setting shows, which MIRROR has to infer; those with ``everything`` read all that
could be seen, as the human model does, those with ``informed`` also get the meaning of messages,
and those with ``pooled`` have one network for all people."""
ASKED_FOR = ("mirror-known-sight", "bc-informed", "bc-informed-pooled", "sqil-informed")
"""Learners compared in prediction on request only: they are given the true sight, or the meaning of
messages where there are none."""
SLOW = ("mirror-nuts",)
"""Learners compared on request only, besides those that a world's record names as slow: a chain of
each person takes minutes."""
PLANNABLE = (
    "mirror",
    "perceptual-only",
    "policy-only",
    "no-implants",
    "bc",
    "bc-informed",
    "sqil",
)
"""Learners that drive a communicator in the assistance study."""
ALSO_PLANNABLE = (
    "mirror-pooled",
    "mirror-population",
    "mirror-known-sight",
    "bc-pooled",
    "bc-informed-pooled",
    "sqil-informed",
    "sqil-pooled",
)
"""Learners that do so on request."""


def is_own(name: str) -> bool:
    """True if a name is that of a human model in a file, ``path/to/file.py:Class``."""
    return ".py:" in name


def learns_from_nothing(name: str) -> bool:
    """True if a learner predicts without any round: human models have a prior."""
    return is_own(name) or not name.startswith(("bc", "sqil", "logistic", "base-rate"))


def learn(name: str, group: Group, rounds: int, seed: int, members: int = 1) -> Learned:
    """Train a learner on the first rounds of a group.

    Args:
        name: in ``LEARNERS``, or ``path/to/file.py:Class``, a user's human model, with the engine
            ``importance``.
        group: the people.
        rounds: number of training rounds; 0 only where :func:`learns_from_nothing`.
        seed: of everything random.
        members: number of networks of each person, for learners that have networks.

    Raises:
        UnknownNameError: there is no such learner.
        HumanModelError: there is no such human model.
        AssetError: no trained guide ships for that domain.
    """
    if is_own(name):
        return _mirror(name)(group, rounds, seed, members)
    if name not in LEARNERS:
        raise UnknownNameError.of("model", name, tuple(LEARNERS))
    return LEARNERS[name](group, rounds, seed, members)

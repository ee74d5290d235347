"""The planners by name, with their settings and constructors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

from mirror_ppl.checks import real_number
from mirror_ppl.communication.communicator import Communicator
from mirror_ppl.communication.hearing import hearing
from mirror_ppl.communication.objectives import (
    Divergence,
    ExpectedUtility,
    ExpectedValue,
    Objective,
)
from mirror_ppl.communication.person import Person
from mirror_ppl.communication.rollouts import SelfModelWorld, SimulatorWorld, World
from mirror_ppl.communication.search import Automatic
from mirror_ppl.domains.base import require_known
from mirror_ppl.domains.record import settings_of
from mirror_ppl.domains.registry import get_domain
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.models.implants import LEAST_PROBABILITY
from mirror_ppl.models.world_knowledge import planning_domain


@dataclass(frozen=True)
class PlannerOptions:
    """Settings of the planners.

    Attributes:
        horizon: number of steps planned ahead.
        discount: per step.
        enumerate_above: see :class:`ExpectedUtility`.
        patience: length of the plans that are compared, see :class:`Automatic`.
        items: most items of a message, see :class:`Automatic`.
        min_standard_errors: standard errors that a gain must exceed, see :class:`Communicator`.
        terminal_value: see :class:`ExpectedUtility`.
        predict_with: what ``mirror`` values the person's actions with: ``simulator``, rolled out;
            ``self-model``, the robot's learned world model, rolled out; or ``values``, the robot's
            action values without a roll-out (:class:`ExpectedValue`), where horizon, discount,
            enumerate_above, patience and terminal_value have no effect.
        hears: prior probability that messages of a modality reach the person
            (:mod:`mirror_ppl.communication.hearing`); 1 assumes that they do.
        kl_weight: units of reward per nat in mirror-kl.
        kl_measure: what mirror-kl measures, see :class:`Divergence`.
    """

    horizon: int = 10
    discount: float = 1.0
    enumerate_above: float = 0.1
    patience: int = 3
    items: int | None = None
    min_standard_errors: float = 2.0
    kl_weight: float = 1.0
    kl_measure: str = "kl"
    terminal_value: bool = False
    predict_with: str = "simulator"
    hears: float = 0.9

    def __post_init__(self) -> None:
        require_known(self.predict_with, "way to predict", tuple(PREDICTIONS))
        object.__setattr__(self, "hears", real_number(self.hears, "hears", LEAST_PROBABILITY, 1.0))

    @classmethod
    def of(cls, domain: str, **changes: Any) -> Self:
        """Return the settings for a domain, with changes; None keeps the domain's setting."""
        given = {name: value for name, value in changes.items() if value is not None}
        return cls(**{**settings_of(get_domain(domain).record, "planning", cls), **given})


def _utility(world: World, options: PlannerOptions) -> Objective:
    return ExpectedUtility(
        world, options.horizon, options.discount, options.enumerate_above, options.terminal_value
    )


def _simulated(person: Person, options: PlannerOptions) -> Objective:
    return _utility(SimulatorWorld(planning_domain(person.human, person.draws)), options)


def _learned(person: Person, options: PlannerOptions) -> Objective:
    return _utility(SelfModelWorld(person.human.self_model), options)


def _valued(person: Person, options: PlannerOptions) -> Objective:
    del person, options
    return ExpectedValue()


PREDICTIONS: Mapping[str, Callable[[Person, PlannerOptions], Objective]] = {
    "simulator": _simulated,
    "self-model": _learned,
    "values": _valued,
}
"""What ``mirror`` can value actions with, by name; see :class:`PlannerOptions`."""


def _mirror(person: Person, options: PlannerOptions) -> Objective:
    return PREDICTIONS[options.predict_with](person, options)


def _mirror_kl(person: Person, options: PlannerOptions) -> Objective:
    del person
    return Divergence(options.kl_weight, options.kl_measure)


PLANNERS: Mapping[str, Callable[[Person, PlannerOptions], Objective]] = {
    "mirror": _mirror,
    "mirror-self-model": _learned,
    "mirror-kl": _mirror_kl,
}
"""Constructors of objectives by name; a new objective is a function and its name here.

``mirror`` maximizes reward in the domain's simulator, unless ``predict_with`` names something else;
``mirror-self-model`` in the robot's learned world model. ``mirror-kl`` minimizes the divergence of
the person's belief from the robot's.
"""


def planner_of(
    name: str, person: Person, options: PlannerOptions, seed: int, *, known: bool = False
) -> Communicator:
    """Make the planner of that name for one person.

    Args:
        name: of the planner.
        person: the person.
        options: settings.
        seed: of the planner's random numbers.
        known: whether the person's draws are their true implants, so that it is not inferred which
            messages reach them.

    Raises:
        UnknownNameError: no planner has that name.
    """
    if name not in PLANNERS:
        raise UnknownNameError.of("planner", name, PLANNERS)
    if not known:
        person = hearing(person, options.hears)
    objective = PLANNERS[name](person, options)
    search = Automatic(options.patience, items=options.items)
    if getattr(objective, "one_step", False):
        search = replace(search, steps=1)
    return Communicator(person, objective, search, options.min_standard_errors, seed)

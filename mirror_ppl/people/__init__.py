"""Simulated people, and recordings of them to which human models are fitted.

The people of a world are in its folder and named in its record. In a world without its own people,
they act like the robot, with limited sight.
"""

from __future__ import annotations

from pathlib import Path

import torch

from mirror_ppl.checks import real_number, seed_number, whole_number
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.devices import usable_device
from mirror_ppl.domains import Domain, get_domain
from mirror_ppl.domains.base import require_known
from mirror_ppl.errors import InputError
from mirror_ppl.models.loading import human_models_of, load_human_model, model_name
from mirror_ppl.models.simulation import PRIOR_OF
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people.base import DomainPeople, SimulatedPeople, act
from mirror_ppl.people.of_human_model import PeopleOfHumanModel, people_from_prior
from mirror_ppl.people.recordings import Start, draw_starts, record, recorded
from mirror_ppl.people.robot_like import POPULATIONS as ROBOT_LIKE
from mirror_ppl.people.robot_like import RobotLike, simulated_robot_like
from mirror_ppl.progress import Progress


def people_of(domain: str) -> DomainPeople | None:
    """Return a domain's own people; None where they act like the robot, with limited sight.

    Raises:
        UnknownNameError: there is no such domain.
    """
    return get_domain(domain).record.part("people")


def simulated_people(
    domain: str,
    setting: str,
    population: str,
    people: int,
    seed: int,
    device: torch.device | str = "cpu",
    self_model: Path | None = None,
    human_model: str | None = None,
) -> SimulatedPeople:
    """Return the simulated people of a population, to be stepped by the caller.

    A seed gives the people that `simulate` records with it; see there for arguments. The population
    may also be the prior of a human model, as recordings name it: of the package, or that of
    ``human_model``, ``path/to/file.py:Class``.

    Raises:
        UnknownNameError: there is no such domain, setting or population.
        AssetError: the self-model that people of a user's world need is missing.
        InputError: fewer than one person, no seed, or the prior of another human model.
        HumanModelError: people of the human model cannot be played step by step.
    """
    world = get_domain(domain)
    model = _model_of(world, population, human_model)
    if model is None:
        require_known(population, "population", populations_of(domain), domain)
    people, seed = whole_number(people, "people", 1), seed_number(seed)
    if model is None and (own := people_of(world.name)) is not None:
        return own.simulated(setting, population, people, seed, device)
    robot, _ = load_self_model(self_model or shipped_weights(world.name), world.name)
    if model is not None:
        require_known(setting, "setting", world.settings, world.name)
        return people_from_prior(load_human_model(model, robot.to(device)), people, seed)
    return simulated_robot_like(robot.to(device), setting, population, people, seed)


def _model_of(world: Domain, population: str, own: str | None) -> str | None:
    """The human model whose prior a population is; None if it is of another kind."""
    if not population.startswith(PRIOR_OF):
        if own is not None:
            raise InputError(f"people of {population} are not drawn from a human model's prior")
        return None
    drawn_from = population.removeprefix(PRIOR_OF)
    if own is not None:
        if ":" not in own:
            raise InputError(f'"{own}" is not of the form path/to/file.py:Class')
        if (given := own.rpartition(":")[2]) != drawn_from:
            raise InputError(f"these people are drawn from the prior of {drawn_from}, not {given}")
        return own
    model = model_name(drawn_from)
    if model not in human_models_of(world):
        raise InputError(
            f"these people are of your own human model {model}, which has to be given to play them"
        )
    return model


def populations_of(domain: str) -> tuple[str, ...]:
    """Return the names of a domain's populations.

    Raises:
        UnknownNameError: there is no such domain.
    """
    own = people_of(domain)
    return ROBOT_LIKE if own is None else own.populations


def has_oracle(domain: str, population: str) -> bool:
    """True if the oracle can compute the best messages to such people.

    It can for a world's own people, unless they need all of a random world's states to be listed,
    for people who follow a human model, and for others unless a setting limits their sight.
    """
    if population.startswith(PRIOR_OF):
        return True
    own = people_of(domain)
    if own is None:
        return population == "diverse"
    return own.oracle is not None or own.best_messages is not None or not get_domain(domain).random


def simulate(  # noqa: PLR0913 - everything recordings can depend on
    domain: str = "driving",
    setting: str | None = None,
    population: str = "paper",
    people: int = 10,
    rounds: int = 40,
    seed: int = 0,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
    told: float = 0.0,
    self_model: Path | None = None,
) -> Demonstrations:
    """Record rounds of simulated people.

    Args:
        domain: a domain's name.
        setting: one of its settings; the last, in which sight is worst, unless given.
        population: the kind of people: ``paper``, sight limited by the setting alone, or
            ``diverse``, sight that differs between people and not between settings.
        people: number of people P.
        rounds: number of rounds B per person.
        seed: a seed gives the same people in every setting, and equal calls equal recordings; each
            setting has its own rounds.
        device: device of the computation and of the recordings. Other kinds of device have other
            random numbers, so the same people play other rounds.
        progress: advanced at every step of the rounds.
        told: probability that a communicable item is communicated, at each step and independent of
            its use; no messages unless given.
        self_model: weights of the robot in a user's world, whose people infer and value as it does
            (:mod:`mirror_ppl.people.robot_like`); those that `train` wrote, by default.

    Returns:
        P people with B rounds each, which end when the task is done. Their true values are
        ``sight_...`` for each of the domain's directions (how far the person sees, in the domain's
        unit of distance; the last of ``reach_bins`` is everything), in driving and on the highway
        ``assumes_...`` for each assumption (1: made); in driving ``consistency`` (1 / units of
        reward), in search and rescue ``lapse`` (probability of a step in a random direction), in
        bomb defusal ``notices_...`` for each terminal (probability of finding it at a step).

    Raises:
        UnknownNameError: there is no such domain, setting, population or device.
        AssetError: a user's world has no self-model.
        InputError: fewer than one person or round, no seed, ``told`` is no probability, or a
            ``self_model`` for people who are not made of one.
    """
    world = get_domain(domain)
    require_known(population, "population", populations_of(domain), domain)
    setting = world.settings[-1] if setting is None else setting
    people, rounds = whole_number(people, "people", 1), whole_number(rounds, "rounds", 1)
    seed, told = seed_number(seed), real_number(told, "told", 0, 1)
    usable_device(str(device))
    if self_model is not None and people_of(world.name) is not None:
        raise InputError(f"people of {world.name} are not made of a self_model")
    own = simulated_people(world.name, setting, population, people, seed, device, self_model)
    return recorded(own, setting, population, rounds, seed, device, progress, told)


__all__ = [
    "DomainPeople",
    "PeopleOfHumanModel",
    "RobotLike",
    "SimulatedPeople",
    "Start",
    "act",
    "draw_starts",
    "has_oracle",
    "people_from_prior",
    "people_of",
    "populations_of",
    "record",
    "simulate",
    "simulated_people",
]

"""Simulated people, and the recordings of them from which models of people are fitted.

A domain's people are in a file of the domain's name; what a new domain has to add is an entry in
``SIMULATORS``.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from mirror_ppl.console import Progress
from mirror_ppl.cross_entropy import CrossEntropyOptions, best_sequences
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains.base import require_known
from mirror_ppl.people.driving import Drivers, Memory, PlanningDrivers, TaskDrivers, remember
from mirror_ppl.people.maximum_entropy import Decisions, LearnedReward, learn_reward, log_policy
from mirror_ppl.people.populations import POPULATIONS
from mirror_ppl.people.recordings import (
    Start,
    draw_starts,
    learned_reward,
    simulate_driving,
    simulated_drivers,
)

SIMULATORS: dict[str, Callable[..., Demonstrations]] = {"driving": simulate_driving}
"""What records simulated people, by the name of the domain."""


def simulate(
    domain: str = "driving",
    setting: str = "fog",
    population: str = "paper",
    people: int = 10,
    rounds: int = 40,
    seed: int = 0,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> Demonstrations:
    """Record rounds of simulated people to whom nobody tells anything.

    Args:
        domain: a domain's name.
        setting: one of its settings.
        population: who the people are; of driving ``paper``, sight limited by the setting alone, or
            ``diverse``, each person's own reach ahead and behind in whatever setting.
        people: number of people P.
        rounds: number of rounds B of each.
        seed: the same seed gives the same people in every setting, and the same call the same
            recordings; each setting has rounds of its own.
        device: where the work is done and the recordings lie. Another kind of device has other
            random numbers, and so the same people in other rounds.
        progress: is told of every step of the rounds (of driving 15).

    Returns:
        P people with B rounds each. Its truths are ``sight_...`` for each of the domain's
        directions (how far the person sees, in the domain's unit of distance; the last of
        ``reach_bins`` is everything), ``assumes_...`` for each of the domain's assumptions (1:
        made) and ``consistency`` (1 / units of reward).

    Raises:
        UnknownNameError: there is no such domain, setting or population.
        ValueError: fewer than one person or round.
    """
    simulator = SIMULATORS[require_known(domain, "domain", tuple(SIMULATORS))]
    for name, number in (("people", people), ("rounds", rounds)):
        if number < 1:
            raise ValueError(f"{name} must be at least 1, not {number}")
    return simulator(setting, population, people, rounds, seed, device, progress)


__all__ = [
    "POPULATIONS",
    "SIMULATORS",
    "CrossEntropyOptions",
    "Decisions",
    "Drivers",
    "LearnedReward",
    "Memory",
    "PlanningDrivers",
    "Start",
    "TaskDrivers",
    "best_sequences",
    "draw_starts",
    "learn_reward",
    "learned_reward",
    "log_policy",
    "remember",
    "simulate",
    "simulated_drivers",
]

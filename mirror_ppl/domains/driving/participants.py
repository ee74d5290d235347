"""Makes the simulated drivers, as in the supplement's section B.

Ten ground-truth people play 24 rounds in each setting, a reward is learned from their actions, and
simulated people plan with it. ``docs/people.md`` explains the steps.
"""

from __future__ import annotations

from functools import lru_cache

import torch

from mirror_ppl.domains.driving.maximum_entropy import Decisions, LearnedReward, learn_reward
from mirror_ppl.domains.driving.oracle import Oracle
from mirror_ppl.domains.driving.people import DISCOUNT, HORIZON, PlanningDrivers, TaskDrivers
from mirror_ppl.domains.driving.populations import POPULATIONS, consistencies, reaches
from mirror_ppl.domains.driving.world import Driving
from mirror_ppl.people.base import DomainPeople
from mirror_ppl.people.recordings import Recording, draw_starts, record
from mirror_ppl.randomness import derived_generator

PARTICIPANTS = 10
"""Number of ground-truth people from whom the reward is learned."""
PARTICIPANT_ROUNDS = 24
"""Number of rounds of each of them in each setting."""


def decisions(recording: Recording) -> Decisions:
    """Return all decisions with the knowledge they were based on, pooled over people and rounds."""
    memory = recording.memory
    return Decisions(
        lane=recording.observation["ego"][:, :, :-1, 0].long().flatten(),
        known=memory.known.flatten(0, 2),
        position=memory.position.flatten(0, 2),
        speed=memory.speed.flatten(0, 2),
        action=recording.actions.flatten(),
    )


def record_participants(setting: str, seed: int) -> Recording:
    """Record ground-truth people in a setting, their sight limited by the setting alone.

    Raises:
        UnknownNameError: there is no such setting.
    """
    drivers = TaskDrivers(
        reach=reaches("paper", setting, PARTICIPANTS, seed),
        consistency=consistencies(PARTICIPANTS, seed),
    )
    rounds = PARTICIPANT_ROUNDS
    return record(drivers, draw_starts(PARTICIPANTS, rounds, seed, "participants", setting))


@lru_cache(maxsize=8)
def learned_reward(seed: int) -> LearnedReward:
    """Learn the reward from the rounds of ground-truth people, pooled over settings."""
    parts = [decisions(record_participants(setting, seed)) for setting in Driving.settings]
    names = Decisions.__dataclass_fields__
    pooled = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    return learn_reward(Decisions(**pooled), HORIZON, DISCOUNT)


def simulated_drivers(
    setting: str, population: str, people: int, seed: int, device: torch.device | str = "cpu"
) -> PlanningDrivers:
    """Return the simulated people of a population, to be stepped by the caller.

    A seed gives the people that `mirror_ppl.people.simulate` records with it.

    Args:
        setting: a setting of the driving domain.
        population: ``paper`` or ``diverse``, see `mirror_ppl.domains.driving.populations.reaches`.
        people: number of people P.
        seed: determines their sight, consistency and reward.
        device: device of their tensors.

    Raises:
        UnknownNameError: there is no such setting or population.
    """
    reach = reaches(population, setting, people, seed).to(device)
    consistency = consistencies(people, seed).to(device)
    planning_seed = derived_generator(seed, "planning").initial_seed()
    return PlanningDrivers(reach, consistency, learned_reward(seed), planning_seed=planning_seed)


DRIVERS = DomainPeople(
    tuple(POPULATIONS), simulated_drivers, lambda driver, start: Oracle(driver, start).messages
)
"""The drivers as registered in the domain's record."""

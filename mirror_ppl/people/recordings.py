"""Recordings of simulated drivers, from the ground truth to the demonstrations that are fitted.

As the supplement's section B builds them: ten people play 24 rounds in each setting, a reward is
learned from all that they did, and simulated people who plan on it play the rounds that are handed
out. ``docs/people.md`` tells the steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from mirror_ppl import __version__
from mirror_ppl.console import Progress
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains.base import Observation, total_reward
from mirror_ppl.domains.driving import SWITCH, Driving, DrivingState
from mirror_ppl.people.driving import (
    DISCOUNT,
    HORIZON,
    Drivers,
    Memory,
    PlanningDrivers,
    TaskDrivers,
)
from mirror_ppl.people.maximum_entropy import Decisions, LearnedReward, learn_reward
from mirror_ppl.people.populations import consistencies, derived_generator, reaches

PARTICIPANTS = 10
"""How many ground-truth people the reward is learned from."""
PARTICIPANT_ROUNDS = 24
"""How many rounds each of them plays in each setting."""


@dataclass(frozen=True)
class Start:
    """How rounds begin, and the random numbers by which their drivers choose.

    Attributes:
        state: states ``[P, B]``.
        scenario: indices into the domain's scenarios ``[P, B]``.
        luck: uniform numbers ``[P, B, T]``; the driver switches lanes where the probability of it
            is larger.
    """

    state: DrivingState
    scenario: Tensor
    luck: Tensor


@dataclass(frozen=True)
class Recording:
    """What happened in rounds.

    Attributes:
        observation: everything there was to observe, ``[P, B, T + 1, ...]``.
        actions: ``[P, B, T]``.
        rewards: of the task, ``[P, B, T]``.
        probabilities: of the actions ``[P, B, T, A]``.
        memory: what the drivers knew when they acted, ``[P, B, T, K]``.
    """

    observation: Observation
    actions: Tensor
    rewards: Tensor
    probabilities: Tensor
    memory: Memory

    @property
    def action_entropy(self) -> Tensor:
        """Entropy of each choice in nats, ``[P, B, T]``."""
        return torch.special.entr(self.probabilities).sum(-1)

    def decisions(self) -> Decisions:
        """Every choice and what it was based on, people and rounds pooled."""
        memory = self.memory
        return Decisions(
            lane=self.observation["ego"][:, :, :-1, 0].long().flatten(),
            known=memory.known.flatten(0, 2),
            position=memory.position.flatten(0, 2),
            speed=memory.speed.flatten(0, 2),
            action=self.actions.flatten(),
        )


def draw_starts(
    people: int, rounds: int, seed: int, *purpose: str, device: torch.device | str = "cpu"
) -> Start:
    """Draw how the rounds ``[P, B]`` begin, for each person from a generator of their own.

    Args:
        people: number of people P.
        rounds: number of rounds B of each.
        seed: with the purpose it determines the rounds.
        purpose: what they are for; other words give other rounds.
        device: where they are drawn and live.
    """
    domain = Driving()
    scenarios, states, luck = [], [], []
    for person in range(people):
        generator = derived_generator(seed, *purpose, person, device=device)
        scenario = torch.randint(
            len(domain.scenarios), (rounds,), generator=generator, device=device
        )
        scenarios.append(scenario)
        states.append(domain.initial(rounds, generator, scenario))
        luck.append(torch.rand(rounds, domain.horizon, generator=generator, device=device))
    state = DrivingState(
        lane=torch.stack([state.lane for state in states]),
        position=torch.stack([state.position for state in states]),
        speed=torch.stack([state.speed for state in states]),
    )
    return Start(state, torch.stack(scenarios), torch.stack(luck))


def record(drivers: Drivers, start: Start, progress: Progress | None = None) -> Recording:
    """Let drivers play rounds to the end; nobody tells them anything.

    Args:
        drivers: P people.
        start: how their rounds ``[P, B]`` begin.
        progress: is told of every step.
    """
    domain = Driving()
    state, memory = start.state, drivers.start(start.luck.shape[1])
    observations, actions, rewards = [domain.observe(state)], [], []
    probabilities, memories = [], []
    for luck in start.luck.unbind(-1):
        probability, memory = drivers.step(memory, observations[-1])
        action = (luck < probability[..., SWITCH]).long()
        following = domain.transition(state, action)
        rewards.append(total_reward(domain.rewards(state, action, following)))
        state = following
        observations.append(domain.observe(state))
        actions.append(action)
        probabilities.append(probability)
        memories.append(memory)
        if progress is not None:
            progress.advance()
    return Recording(
        observation={
            name: torch.stack([part[name] for part in observations], 2) for name in observations[0]
        },
        actions=torch.stack(actions, 2),
        rewards=torch.stack(rewards, 2),
        probabilities=torch.stack(probabilities, 2),
        memory=Memory.stack(memories, 2),
    )


def record_participants(setting: str, seed: int) -> Recording:
    """The ground-truth people's rounds in a setting, limited in sight by the setting alone.

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
    """The reward learned from the rounds of the ground-truth people in every setting, pooled."""
    parts = [record_participants(setting, seed).decisions() for setting in Driving.settings]
    names = Decisions.__dataclass_fields__
    pooled = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    return learn_reward(Decisions(**pooled), HORIZON, DISCOUNT)


def simulated_drivers(
    setting: str, population: str, people: int, seed: int, device: torch.device | str = "cpu"
) -> PlanningDrivers:
    """The simulated people of a population, to be stepped by whoever wants to.

    The same seed gives the same people, those that `simulate_driving` records.

    Args:
        setting: a setting of the driving domain.
        population: ``paper`` or ``diverse``, see `mirror_ppl.people.populations.reaches`.
        people: number of people P.
        seed: determines their sight, consistency and reward.
        device: where they live.

    Raises:
        UnknownNameError: there is no such setting or population.
    """
    reach = reaches(population, setting, people, seed).to(device)
    consistency = consistencies(people, seed).to(device)
    planning_seed = derived_generator(seed, "planning").initial_seed()
    return PlanningDrivers(reach, consistency, learned_reward(seed), planning_seed=planning_seed)


def simulate_driving(
    setting: str,
    population: str,
    people: int,
    rounds: int,
    seed: int,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> Demonstrations:
    """Recordings of simulated drivers; see `mirror_ppl.people.simulate`."""
    drivers = simulated_drivers(setting, population, people, seed, device)
    start = draw_starts(people, rounds, seed, "rounds", setting, device=device)
    recording = record(drivers, start, progress)
    sight = zip(Driving.directions, drivers.reach.unbind(-1), strict=True)
    return Demonstrations(
        domain=Driving.name,
        setting=setting,
        people=tuple(f"person-{number:02d}" for number in range(1, people + 1)),
        ego=recording.observation["ego"],
        observations={part.name: recording.observation[part.name] for part in Driving.modalities},
        actions=recording.actions,
        round_counts=torch.full((people,), rounds),
        lengths=torch.full((people, rounds), Driving.horizon),
        rewards=recording.rewards,
        scenarios=start.scenario,
        truth={
            **{f"sight_{direction}": reach for direction, reach in sight},
            **{f"assumes_{name}": torch.ones(people) for name in Driving.assumptions},
            "consistency": drivers.consistency,
        },
        action_entropy=recording.action_entropy,
        provenance={"population": population, "seed": seed, "version": __version__},
    )

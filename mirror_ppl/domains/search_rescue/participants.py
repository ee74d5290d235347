"""Makes the simulated firefighters, as in the supplement's section B.

Participants play 36 rounds in each setting, their transitions between subgoals are learned from
their actions, and simulated people follow the learned transitions. ``docs/people.md`` explains the
steps.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor

from mirror_ppl.domains.base import require_known
from mirror_ppl.domains.search_rescue.house import CORRIDORS, ROOMS
from mirror_ppl.domains.search_rescue.knowledge import HouseKnowledge
from mirror_ppl.domains.search_rescue.people import (
    HOME,
    SUBGOALS,
    SimulatedFirefighters,
    possible_rooms,
    possible_subgoals,
    subgoal_distances,
)
from mirror_ppl.domains.search_rescue.world import SMOKE_REACH, SearchRescue
from mirror_ppl.minimization import minimize
from mirror_ppl.people.base import DomainPeople
from mirror_ppl.people.recordings import Recording, draw_starts, record
from mirror_ppl.randomness import derived_generator

PARTICIPANT_ROUNDS = 36
"""Number of rounds of a participant in each setting."""
HABIT_SPREAD = 0.7
"""Standard deviation over people and choices of the log preference for a choice."""
PATIENCE_MEDIAN, PATIENCE_SPREAD = 1.0, 0.3
"""Median over people of the extra steps that make a path e times less probable, and standard
deviation of its logarithm."""
LAPSE_MEDIAN, LAPSE_SPREAD = 0.03, 0.5
"""Median over people of the lapse probability, and standard deviation of its logarithm."""
LEARNING_STEPS = 200
RADII = (SMOKE_REACH, 2.3, 3.2, 4.2, 5.7)
"""Possible radii in the population ``diverse``, in cells."""


def _by_setting(setting: str, people: int, seed: int) -> Tensor:
    del seed
    everything = SearchRescue.reach_bins[-1]
    return torch.full((people,), SMOKE_REACH if setting == "smoke" else everything)


def _by_person(setting: str, people: int, seed: int) -> Tensor:
    del setting
    drawn = [
        torch.randint(len(RADII), (), generator=derived_generator(seed, "radius", person))
        for person in range(people)
    ]
    return torch.tensor(RADII)[torch.stack(drawn)]


RESCUE_POPULATIONS: dict[str, Callable[[str, int, int], Tensor]] = {
    "paper": _by_setting,
    "diverse": _by_person,
}
"""Populations: radius of each person, given setting, number of people and seed."""


def participants(setting: str, people: int, seed: int) -> SimulatedFirefighters:
    """Draw ground-truth people with habits who prefer short paths; the setting limits sight."""
    habits, patiences, lapses = [], [], []
    for person in range(people):
        generator = derived_generator(seed, "habits", person)
        habits.append(HABIT_SPREAD * torch.randn(len(SUBGOALS), len(SUBGOALS), generator=generator))
        haste, lapse = torch.randn(2, generator=generator)
        patiences.append(PATIENCE_MEDIAN * (PATIENCE_SPREAD * haste).exp())
        lapses.append(LAPSE_MEDIAN * (LAPSE_SPREAD * lapse).exp())
    return SimulatedFirefighters(
        radius=_by_setting(setting, people, seed),
        transitions=transitions_of(torch.stack(habits), torch.stack(patiences)),
        lapse=torch.stack(lapses),
    )


def transitions_of(habit: Tensor, patience: Tensor) -> Tensor:
    """Return probabilities of P people's next subgoals, ``[P, 8, 6, 6]``.

    They decrease with the steps of the path through a subgoal, as far as it is known.

    Args:
        habit: preference of each for each transition, ``[P, 6, 6]``, in nats.
        patience: extra steps that make a path e times less probable, ``[P]``.
    """
    return (habit[:, None] - _steps_by_way() / patience[:, None, None, None]).softmax(-1)


@lru_cache
def _steps_by_way() -> Tensor:
    """Return steps of the path to a subgoal and beyond ``[8, 6, 6]``, by `possible_rooms`."""
    far = subgoal_distances().to(torch.get_default_dtype())
    corridors, rooms = slice(0, len(CORRIDORS)), slice(len(CORRIDORS), HOME)
    steps = far.repeat(2 ** len(ROOMS), 1, 1)
    for some in range(1, 2 ** len(ROOMS)):
        may_be = [room for room in range(len(ROOMS)) if some >> room & 1]
        steps[some, HOME, corridors] += far[corridors, rooms][:, may_be].mean(-1)
    steps[:, rooms, corridors] += far[corridors, HOME]
    return steps


def learn_transitions(recordings: list[Recording]) -> Tensor:
    """Learn transitions between subgoals of P people, ``[P, 8, 6, 6]``, from recordings.

    A choice was made wherever the subgoal changed, among the subgoals that were possible then.
    Habits and patience are at their posterior mode, found by L-BFGS.

    Args:
        recordings: of the same people, in any settings.
    """
    people, number = recordings[0].actions.shape[0], len(SUBGOALS)
    places, chosen, possible = [], [], []
    for recording in recordings:
        mind = recording.memory
        first = torch.full_like(mind.goal[:, :, :1], HOME)
        before = torch.cat([first, mind.goal[:, :, :-1]], 2)
        now = {name: value[:, :, :-1] for name, value in recording.observation.items()}
        knowledge = HouseKnowledge(mind.corridors, mind.rooms)
        may = possible_subgoals(knowledge, now)
        changed = (before != mind.goal) & (may.sum(-1) > 1)
        who = changed.nonzero()[:, 0]
        places.append(torch.stack([who, possible_rooms(knowledge, now)[changed], before[changed]]))
        chosen.append(mind.goal[changed])
        possible.append(may[changed])
    place, choice, may = torch.cat(places, 1), torch.cat(chosen), torch.cat(possible)
    habit = torch.zeros(people, number, number, requires_grad=True)
    haste = torch.zeros(people, requires_grad=True)

    def patience() -> Tensor:
        return PATIENCE_MEDIAN * (PATIENCE_SPREAD * haste).exp()

    def loss() -> Tensor:
        liked = transitions_of(HABIT_SPREAD * habit, patience())[tuple(place)] * may
        chance = liked.gather(-1, choice[:, None]).squeeze(-1) / liked.sum(-1)
        return 0.5 * (habit.pow(2).sum() + haste.pow(2).sum()) - chance.log().sum()

    minimize(loss, [habit, haste], LEARNING_STEPS)
    with torch.no_grad():
        return transitions_of(HABIT_SPREAD * habit, patience())


@lru_cache(maxsize=8)
def learned_transitions(people: int, seed: int) -> Tensor:
    """Learn the participants' transitions ``[P, 8, 6, 6]`` from their rounds in every setting."""
    rounds, domain = PARTICIPANT_ROUNDS, SearchRescue()
    recordings = []
    for setting in domain.settings:
        start = draw_starts(
            people,
            rounds,
            seed,
            "participants",
            setting,
            domain=domain,
            mind_noises=SimulatedFirefighters.mind_noises,
        )
        recordings.append(record(participants(setting, people, seed), start))
    return learn_transitions(recordings)


def simulated_firefighters(
    setting: str, population: str, people: int, seed: int, device: torch.device | str = "cpu"
) -> SimulatedFirefighters:
    """Return the simulated people of a population, to be stepped by the caller.

    Each is made from one participant. The same seed gives the same people.

    Args:
        setting: a setting of search and rescue.
        population: ``paper``, sight limited by the setting alone; ``diverse``, each person's own
            radius in every setting.
        people: number of people P.
        seed: determines their sight, habits and lapse probability.
        device: device of their tensors.

    Raises:
        UnknownNameError: there is no such setting or population.
    """
    require_known(setting, "setting", SearchRescue.settings, SearchRescue.name)
    require_known(population, "population", tuple(RESCUE_POPULATIONS), SearchRescue.name)
    return SimulatedFirefighters(
        radius=RESCUE_POPULATIONS[population](setting, people, seed).to(device),
        transitions=learned_transitions(people, seed).to(device),
        lapse=participants(setting, people, seed).lapse.to(device),
    )


FIREFIGHTERS = DomainPeople(tuple(RESCUE_POPULATIONS), simulated_firefighters)
"""The firefighters as registered in the domain's record."""

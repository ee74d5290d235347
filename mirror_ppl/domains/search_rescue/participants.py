"""The people of search and rescue, from the ground truth to those who are handed out.

As the supplement's section B builds them: participants play 36 rounds in each setting, how each of
them goes on from one subgoal to the next is learned from what they did, and simulated people who do
so play the rounds that are handed out. ``docs/people.md`` tells the steps.
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
from mirror_ppl.people.base import DomainPeople, derived_generator
from mirror_ppl.people.recordings import Recording, draw_starts, record

PARTICIPANT_ROUNDS = 36
"""How many rounds a participant plays in each setting."""
HABIT_SPREAD = 0.7
"""Standard deviation over people and choices of how much somebody likes one, as a logarithm."""
PATIENCE_MEDIAN, PATIENCE_SPREAD = 1.0, 0.3
"""Median over people of the steps by which a way may be longer to be chosen e times more seldom,
and standard deviation of its logarithm."""
LAPSE_MEDIAN, LAPSE_SPREAD = 0.03, 0.5
"""Median over people of how often they step anywhere, and standard deviation of its logarithm."""
LEARNING_STEPS = 200
RADII = (SMOKE_REACH, 2.3, 3.2, 4.2, 5.7)
"""What radii there are in the population ``diverse``, in cells."""


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
"""Populations: how far each person sees, given setting, number of people and seed."""


def participants(setting: str, people: int, seed: int) -> SimulatedFirefighters:
    """The ground truth: people of habits who like short ways, with sight limited by the setting."""
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
    """How likely P people go on to a subgoal from another, ``[P, 8, 6, 6]``.

    It falls with the steps of the way by it, as far as they know where it has to lead.

    Args:
        habit: how much each likes to go on so, ``[P, 6, 6]``, in nats.
        patience: how many steps more make a way e times less likely, ``[P]``.
    """
    return (habit[:, None] - _steps_by_way() / patience[:, None, None, None]).softmax(-1)


@lru_cache
def _steps_by_way() -> Tensor:
    """Steps of the way to a subgoal and on from there ``[8, 6, 6]``, by `possible_rooms`."""
    far = subgoal_distances().to(torch.get_default_dtype())
    corridors, rooms = slice(0, len(CORRIDORS)), slice(len(CORRIDORS), HOME)
    steps = far.repeat(2 ** len(ROOMS), 1, 1)
    for some in range(1, 2 ** len(ROOMS)):
        may_be = [room for room in range(len(ROOMS)) if some >> room & 1]
        steps[some, HOME, corridors] += far[corridors, rooms][:, may_be].mean(-1)
    steps[:, rooms, corridors] += far[corridors, HOME]
    return steps


def learn_transitions(recordings: list[Recording]) -> Tensor:
    """How each of P people goes on from a subgoal, ``[P, 8, 6, 6]``, learned from what they did.

    A choice was made wherever the subgoal changed, among the subgoals that were possible then.
    Habits and patience are those of the largest posterior density, by Newton-like steps (L-BFGS).

    Args:
        recordings: of the same people, in whatever settings.
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
    optimizer = torch.optim.LBFGS(
        [habit, haste], max_iter=LEARNING_STEPS, line_search_fn="strong_wolfe"
    )

    def patience() -> Tensor:
        return PATIENCE_MEDIAN * (PATIENCE_SPREAD * haste).exp()

    def loss() -> Tensor:
        optimizer.zero_grad()
        liked = transitions_of(HABIT_SPREAD * habit, patience())[tuple(place)] * may
        chance = liked.gather(-1, choice[:, None]).squeeze(-1) / liked.sum(-1)
        value = 0.5 * (habit.pow(2).sum() + haste.pow(2).sum()) - chance.log().sum()
        value.backward()
        return value

    with torch.enable_grad():
        optimizer.step(loss)
    with torch.no_grad():
        return transitions_of(HABIT_SPREAD * habit, patience())


@lru_cache(maxsize=8)
def learned_transitions(people: int, seed: int) -> Tensor:
    """How the participants go on ``[P, 8, 6, 6]``, learned from their rounds in every setting."""
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
    """The simulated people of a population, to be stepped by whoever wants to.

    Each is made for one participant. The same seed gives the same people.

    Args:
        setting: a setting of search and rescue.
        population: ``paper``, sight limited by the setting alone; ``diverse``, each person's own
            radius in every setting.
        people: number of people P.
        seed: determines their sight, their habits, and how often they step anywhere.
        device: where they live.

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
"""What the rest of the package knows of them."""

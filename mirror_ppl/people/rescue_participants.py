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
from mirror_ppl.domains.rescue_house import CORRIDORS, ROOMS
from mirror_ppl.domains.rescue_knowledge import HouseKnowledge
from mirror_ppl.domains.search_rescue import SMOKE_REACH, SearchRescue
from mirror_ppl.people.populations import derived_generator
from mirror_ppl.people.recordings import Recording, draw_starts, record
from mirror_ppl.people.search_rescue import (
    HOME,
    SUBGOALS,
    Firefighters,
    known_victim,
    possible_subgoals,
    subgoal_distances,
)

PARTICIPANT_ROUNDS = 36
"""How many rounds a participant plays in each setting."""
HABIT_SPREAD = 0.7
"""Standard deviation over people and choices of how much somebody likes one, as a logarithm."""
PATIENCE_MEDIAN, PATIENCE_SPREAD = 2.0, 0.3
"""Median over people of the steps by which a way may be longer to be chosen e times more seldom,
and standard deviation of its logarithm."""
LAPSE_MEDIAN, LAPSE_SPREAD = 0.03, 0.5
"""Median over people of how often they step anywhere, and standard deviation of its logarithm."""
PRIOR_COUNT = 0.2
"""How often each transition counts as seen before any was."""
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


def participants(setting: str, people: int, seed: int) -> Firefighters:
    """The ground truth: people who like short ways, with habits, limited in sight by the setting.

    How likely somebody goes on to a subgoal falls with the steps of the way by it, as far as they
    know where it has to lead, and is more or less by habit.
    """
    steps = _steps_by_way()
    transitions, lapses = [], []
    for person in range(people):
        generator = derived_generator(seed, "habits", person)
        habit = HABIT_SPREAD * torch.randn(steps.shape[1:], generator=generator)
        haste, lapse = torch.randn(2, generator=generator)
        patience = PATIENCE_MEDIAN * (PATIENCE_SPREAD * haste).exp()
        transitions.append((habit - steps / patience).softmax(-1))
        lapses.append(LAPSE_MEDIAN * (LAPSE_SPREAD * lapse).exp())
    return Firefighters(
        radius=_by_setting(setting, people, seed),
        transitions=torch.stack(transitions),
        lapse=torch.stack(lapses),
    )


def _steps_by_way() -> Tensor:
    """Steps of the way to a subgoal and on from there, ``[4, 6, 6]``; as `transitions`."""
    far = subgoal_distances().to(torch.get_default_dtype())
    corridors, rooms = slice(0, len(CORRIDORS)), slice(len(CORRIDORS), HOME)
    steps = far.repeat(1 + len(ROOMS), 1, 1)
    onwards = far[corridors, rooms]
    steps[0, HOME, corridors] += onwards.mean(-1)
    steps[1:, HOME, corridors] += onwards.T
    steps[:, rooms, corridors] += far[corridors, HOME]
    return steps


def learn_transitions(recordings: list[Recording]) -> Tensor:
    """How each of P people goes on from a subgoal, ``[P, 4, 6, 6]``, learned from what they did.

    A choice was made wherever the subgoal changed, among the subgoals that were possible then. The
    likelihood of such choices (Luce's, as of `Firefighters`) has its maximum, with a few made-up
    choices of each kind, at the end of Hunter's minorize-maximize steps (2004).

    Args:
        recordings: of the same people, in whatever settings.
    """
    people = recordings[0].actions.shape[0]
    number, kinds = len(SUBGOALS), 1 + len(ROOMS)
    sources, chosen, possible = [], [], []
    for recording in recordings:
        mind = recording.memory
        first = torch.full_like(mind.goal[:, :, :1], HOME)
        before = torch.cat([first, mind.goal[:, :, :-1]], 2)
        now = {name: value[:, :, :-1] for name, value in recording.observation.items()}
        knowledge = HouseKnowledge(mind.corridors, mind.rooms)
        may = possible_subgoals(knowledge, now)
        changed = (before != mind.goal) & (may.sum(-1) > 1)
        who = changed.nonzero()[:, 0]
        victim = known_victim(knowledge, now)[changed]
        sources.append((who * kinds + victim) * number + before[changed])
        chosen.append(mind.goal[changed])
        possible.append(may[changed])
    source, choice, may = torch.cat(sources), torch.cat(chosen), torch.cat(possible).double()
    counts = torch.full((people * kinds * number, number), PRIOR_COUNT, dtype=torch.double)
    counts.index_put_((source, choice), torch.ones(len(choice), dtype=torch.double), True)
    worth = torch.full_like(counts, 1 / number)
    for _ in range(LEARNING_STEPS):
        share = may / (worth[source] * may).sum(-1, keepdim=True)
        # Made-up choices were among all subgoals.
        told = torch.full_like(counts, PRIOR_COUNT * number).index_add(0, source, share)
        worth = counts / told
        worth = worth / worth.sum(-1, keepdim=True)
    return worth.view(people, kinds, number, number).to(torch.get_default_dtype())


@lru_cache(maxsize=8)
def learned_transitions(people: int, seed: int) -> Tensor:
    """How the participants go on ``[P, 4, 6, 6]``, learned from their rounds in every setting."""
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
            fates=Firefighters.fates,
        )
        recordings.append(record(participants(setting, people, seed), start))
    return learn_transitions(recordings)


def simulated_firefighters(
    setting: str, population: str, people: int, seed: int, device: torch.device | str = "cpu"
) -> Firefighters:
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
    require_known(setting, "setting", SearchRescue.settings)
    require_known(population, "population", tuple(RESCUE_POPULATIONS))
    return Firefighters(
        radius=RESCUE_POPULATIONS[population](setting, people, seed).to(device),
        transitions=learned_transitions(people, seed).to(device),
        lapse=participants(setting, people, seed).lapse.to(device),
    )

"""The people of search and rescue, from the ground truth to those who are handed out.

As the supplement's section B builds them: participants play 36 rounds in each setting, how each of
them goes on from one subgoal to the next is learned from what they did, and simulated people who do
so play the rounds that are handed out. ``docs/people.md`` tells the steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor

from mirror_ppl.domains.base import require_known
from mirror_ppl.domains.rescue_knowledge import HouseKnowledge
from mirror_ppl.domains.search_rescue import SMOKE_REACH, SearchRescue
from mirror_ppl.people.populations import derived_generator
from mirror_ppl.people.recordings import Recording, draw_starts, record
from mirror_ppl.people.search_rescue import HOME, SUBGOALS, Firefighters, possible_subgoals

PARTICIPANT_ROUNDS = 36
"""How many rounds a participant plays in each setting."""
LAPSE_MEDIAN, LAPSE_SPREAD = 0.03, 0.5
"""Median over people of how often they step anywhere, and standard deviation of its logarithm."""
PRIOR_COUNT = 0.5
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
    """The ground truth: people with habits of their own, limited in sight by the setting alone."""
    transitions, lapses = [], []
    for person in range(people):
        generator = derived_generator(seed, "habits", person)
        # Exponential numbers, normalized, are a draw from a flat Dirichlet distribution.
        habits = -torch.rand(len(SUBGOALS), len(SUBGOALS), generator=generator).log()
        transitions.append(habits / habits.sum(-1, keepdim=True))
        lapses.append(LAPSE_SPREAD * torch.randn((), generator=generator))
    return Firefighters(
        radius=_by_setting(setting, people, seed),
        transitions=torch.stack(transitions),
        lapse=(math.log(LAPSE_MEDIAN) + torch.stack(lapses)).exp(),
    )


def learn_transitions(recordings: list[Recording]) -> Tensor:
    """How each of P people goes on from a subgoal, ``[P, 6, 6]``, learned from what they did.

    A choice was made wherever the subgoal changed, among the subgoals that were possible then. The
    likelihood of such choices (Luce's, as of `Firefighters`) has its maximum, with a few made-up
    choices of each kind, at the end of Hunter's minorize-maximize steps (2004).

    Args:
        recordings: of the same people, in whatever settings.
    """
    people = recordings[0].actions.shape[0]
    number = len(SUBGOALS)
    before, after, possible, who = [], [], [], []
    for recording in recordings:
        mind = recording.memory
        first = torch.full_like(mind.goal[:, :, :1], HOME)
        previous = torch.cat([first, mind.goal[:, :, :-1]], 2)
        now = {name: value[:, :, :-1] for name, value in recording.observation.items()}
        may = possible_subgoals(HouseKnowledge(mind.corridors, mind.rooms), now)
        changed = (previous != mind.goal) & (may.sum(-1) > 1)
        before.append(previous[changed])
        after.append(mind.goal[changed])
        possible.append(may[changed])
        who.append(changed.nonzero()[:, 0])
    source = torch.cat(who) * number + torch.cat(before)
    chosen, open_ = torch.cat(after), torch.cat(possible).double()
    counts = torch.full((people * number, number), PRIOR_COUNT, dtype=torch.double)
    counts.index_put_((source, chosen), torch.ones(len(chosen), dtype=torch.double), True)
    worth = torch.full_like(counts, 1 / number)
    for _ in range(LEARNING_STEPS):
        share = open_ / (worth[source] * open_).sum(-1, keepdim=True)
        # Made-up choices were among all subgoals.
        told = torch.full_like(counts, PRIOR_COUNT * number).index_add(0, source, share)
        worth = counts / told
        worth = worth / worth.sum(-1, keepdim=True)
    return worth.view(people, number, number).to(torch.get_default_dtype())


@lru_cache(maxsize=8)
def learned_transitions(people: int, seed: int) -> Tensor:
    """How the participants go on ``[P, 6, 6]``, learned from their rounds in every setting."""
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

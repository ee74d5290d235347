"""The people of bomb defusal, from the ground truth to those who are handed out.

As the supplement's section B builds them: participants who are told the type play 36 rounds each,
how long each takes to find a terminal is described by a geometric distribution whose probability is
learned from that, and simulated people who take as long play the rounds that are handed out.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from mirror_ppl.domains.base import require_known
from mirror_ppl.domains.bomb_defusal.panel import STAGES, TERMINALS, read_panel
from mirror_ppl.domains.bomb_defusal.people import SimulatedDefusers
from mirror_ppl.domains.bomb_defusal.world import WAIT, BombDefusal
from mirror_ppl.people.base import DomainPeople, derived_generator
from mirror_ppl.people.recordings import Recording, draw_starts, record

PARTICIPANT_ROUNDS = 36
"""How many rounds a participant plays."""
NOTICE_MEDIAN, NOTICE_SPREAD = 0.05, 0.35
"""Median over people of how probably they find a terminal at a step, and standard deviation of its
logarithm."""
PLACE_SPREAD = 0.5
"""Standard deviation over terminals of the same, for one person of the population ``diverse``."""
DEFUSER_POPULATIONS = ("paper", "diverse")
"""Who people may be: as quick at every terminal, or at some quicker than at others."""


def participants(people: int, seed: int, by_place: bool = False) -> SimulatedDefusers:
    """The ground truth: how quick each is, and everybody is told the type.

    Args:
        people: number of people P.
        seed: determines them.
        by_place: whether some terminals are found sooner than others.
    """
    drawn = []
    for person in range(people):
        noise = torch.randn(
            1 + TERMINALS, generator=derived_generator(seed, "notices", person)
        ) * torch.tensor([NOTICE_SPREAD] + [PLACE_SPREAD * by_place] * TERMINALS)
        drawn.append(NOTICE_MEDIAN * (noise[0] + noise[1:]).exp())
    return SimulatedDefusers(
        torch.stack(drawn).clamp(max=1.0), torch.ones(people, dtype=torch.bool)
    )


def learn_notices(recording: Recording, by_place: bool = False) -> Tensor:
    """How probably each of P people finds each terminal at a step, ``[P, 6]``.

    The likeliest: times found in steps searched. Of a terminal that somebody never found it is as
    if they had found it at the next step.

    Args:
        recording: of people who know the type.
        by_place: learn it of each terminal by itself, and not of all together.
    """
    now = {name: value[:, :, :-1] for name, value in recording.observation.items()}
    live, _ = read_panel(now["visual"])
    under_way = now["ego"][..., 0] < STAGES
    own = (torch.arange(TERMINALS) == live[..., None]) & under_way[..., None]
    found = own & (recording.actions != WAIT)[..., None]
    searched, times = (part.sum((1, 2)).to(torch.get_default_dtype()) for part in (own, found))
    if not by_place:
        searched, times = (part.sum(-1, keepdim=True) for part in (searched, times))
    never = times == 0
    return ((times + never) / (searched + never)).expand(-1, TERMINALS).contiguous()


@lru_cache(maxsize=8)
def learned_notices(people: int, seed: int, by_place: bool) -> Tensor:
    """How probably the participants find each terminal ``[P, 6]``, learned from their rounds."""
    start = draw_starts(
        people,
        PARTICIPANT_ROUNDS,
        seed,
        "participants",
        domain=BombDefusal(),
        mind_noises=SimulatedDefusers.mind_noises,
    )
    return learn_notices(record(participants(people, seed, by_place), start), by_place)


def simulated_defusers(
    setting: str, population: str, people: int, seed: int, device: torch.device | str = "cpu"
) -> SimulatedDefusers:
    """The simulated people of a population, to be stepped by whoever wants to.

    Each is made for one participant. The same seed gives the same people.

    Args:
        setting: ``labelled``, in which they read the type, or ``unlabelled``.
        population: ``paper``, as quick at every terminal; ``diverse``, quicker at some.
        people: number of people P.
        seed: determines how quick they are.
        device: where they live.

    Raises:
        UnknownNameError: there is no such setting or population.
    """
    require_known(setting, "setting", BombDefusal.settings, BombDefusal.name)
    require_known(population, "population", DEFUSER_POPULATIONS, BombDefusal.name)
    reads = torch.full((people,), setting == "labelled", device=device)
    return SimulatedDefusers(
        learned_notices(people, seed, population == "diverse").to(device), reads
    )


DEFUSERS = DomainPeople(DEFUSER_POPULATIONS, simulated_defusers)
"""What the rest of the package knows of them."""

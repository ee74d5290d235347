"""Makes the simulated people of bomb defusal, as in the supplement's section B.

Participants who know the type play 36 rounds each, the probability of a geometric distribution of
their search times is estimated, and simulated people follow the estimated distributions.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from mirror_ppl.domains.base import require_known
from mirror_ppl.domains.bomb_defusal.panel import STAGES, TERMINALS, read_panel
from mirror_ppl.domains.bomb_defusal.people import SimulatedDefusers
from mirror_ppl.domains.bomb_defusal.world import WAIT, BombDefusal
from mirror_ppl.people.base import DomainPeople
from mirror_ppl.people.recordings import Recording, draw_starts, record
from mirror_ppl.randomness import derived_generator

PARTICIPANT_ROUNDS = 36
"""Number of rounds of a participant."""
NOTICE_MEDIAN, NOTICE_SPREAD = 0.05, 0.35
"""Median over people of the probability of finding a terminal at a step, and standard deviation of
its logarithm."""
PLACE_SPREAD = 0.5
"""Standard deviation over terminals of this logarithm for a person of population ``diverse``."""
DEFUSER_POPULATIONS = ("paper", "diverse")
"""Populations: equally quick at every terminal, or quicker at some."""


def participants(people: int, seed: int, by_place: bool = False) -> SimulatedDefusers:
    """Draw ground-truth people with their search probabilities; all of them know the type.

    Args:
        people: number of people P.
        seed: determines them.
        by_place: whether search probabilities differ between terminals.
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
    """Estimate the probability of finding each terminal at a step for P people, ``[P, 6]``.

    The maximum-likelihood estimate is finds per step searched. A terminal that was never found
    counts as found at the next step.

    Args:
        recording: of people who know the type.
        by_place: estimate each terminal separately, not all together.
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
    """Estimate the participants' search probabilities ``[P, 6]`` from their rounds."""
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
    """Return the simulated people of a population, to be stepped by the caller.

    Each is made from one participant. The same seed gives the same people.

    Args:
        setting: ``labelled``, in which they read the type, or ``unlabelled``.
        population: ``paper``, equally quick at every terminal; ``diverse``, quicker at some.
        people: number of people P.
        seed: determines their search probabilities.
        device: device of their tensors.

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
"""The people as registered in the domain's record."""

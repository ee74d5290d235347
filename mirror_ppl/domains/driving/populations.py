"""Populations of drivers: the sight and consistency of each person.

Every draw comes from a generator derived from the seed, its purpose and the person's number. So
person 3 of a seed is the same in every setting and for any number of people.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from mirror_ppl.domains.base import require_known
from mirror_ppl.domains.driving.knowledge import ROAD_END
from mirror_ppl.domains.driving.world import FOG_REACH, Driving
from mirror_ppl.randomness import derived_generator

CONSISTENCY_MEDIAN = 3.0
"""Median over people of the consistency, in 1 / units of reward."""
CONSISTENCY_SPREAD = 0.35
"""Standard deviation over people of its logarithm."""

SETTING_REACH = {
    "clear": (ROAD_END, ROAD_END, ROAD_END, ROAD_END),
    "fog": (FOG_REACH, FOG_REACH, 0, 0),
}
"""Reach in each setting, in cells, for each of ``Driving.directions``."""
REACHES_AHEAD = (1, 2, 3, 4, 6)
"""Possible reaches ahead in the population ``diverse``, in cells."""
REACHES_BEHIND = (0, 1, 2, 3, 4)
"""Possible reaches behind in the population ``diverse``, in cells; 0 is no sight."""


def consistencies(people: int, seed: int) -> Tensor:
    """Draw each person's consistency ``[P]`` in 1 / units of reward, log-normal."""
    noise = [
        torch.randn((), generator=derived_generator(seed, "consistency", person))
        for person in range(people)
    ]
    return (math.log(CONSISTENCY_MEDIAN) + CONSISTENCY_SPREAD * torch.stack(noise)).exp()


def reaches(population: str, setting: str, people: int, seed: int) -> Tensor:
    """Return each person's reach in cells, ``[P, 4]`` for each of ``Driving.directions``.

    Args:
        population: a name in ``POPULATIONS``: ``paper``, sight limited by the setting alone;
            ``diverse``, each person's own reach ahead and behind, equal in both lanes and all
            settings.
        setting: a setting of the driving domain.
        people: number of people P.
        seed: the same seed gives the same people.

    Raises:
        UnknownNameError: there is no such population or setting.
    """
    require_known(setting, "setting", Driving.settings, Driving.name)
    require_known(population, "population", tuple(POPULATIONS), Driving.name)
    return POPULATIONS[population](setting, people, seed)


def _by_setting(setting: str, people: int, seed: int) -> Tensor:
    reach = torch.tensor(SETTING_REACH[setting], dtype=torch.get_default_dtype())
    return reach.repeat(people, 1)


def _by_person(setting: str, people: int, seed: int) -> Tensor:
    def choice(options: tuple[int, ...], generator: torch.Generator) -> int:
        return options[int(torch.randint(len(options), (), generator=generator))]

    rows = []
    for person in range(people):
        generator = derived_generator(seed, "reach", person)
        ahead, behind = choice(REACHES_AHEAD, generator), choice(REACHES_BEHIND, generator)
        rows.append((ahead, ahead, behind, behind))
    return torch.tensor(rows, dtype=torch.get_default_dtype())


POPULATIONS: dict[str, Callable[[str, int, int], Tensor]] = {
    "paper": _by_setting,
    "diverse": _by_person,
}
"""Populations of drivers: reach of each person, given setting, number of people and seed."""

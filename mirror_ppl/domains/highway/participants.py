"""Populations of simulated drivers, and the best messages to them."""

from __future__ import annotations

import torch
from torch import Tensor

from mirror_ppl.communication.messages import Channels
from mirror_ppl.domains.base import map_state, require_known
from mirror_ppl.domains.highway import expert
from mirror_ppl.domains.highway.lidar import RANGE
from mirror_ppl.domains.highway.people import HighwayDrivers
from mirror_ppl.domains.highway.world import FOG_AHEAD, FOG_BEHIND, Highway
from mirror_ppl.people.base import DomainPeople
from mirror_ppl.randomness import derived_generator

CONSISTENCY_MEDIAN, CONSISTENCY_SPREAD = 1.0, 0.35
"""Median over drivers of the consistency, and spread of its logarithm."""
CAUTION_SPREAD = 0.3
"""Standard deviation over drivers of the logarithm of their caution."""
SETTING_REACH = {
    "clear": (RANGE, RANGE, RANGE, RANGE),
    "fog": (FOG_AHEAD, FOG_AHEAD, FOG_BEHIND, FOG_BEHIND),
}
"""Metres that all see, in each of ``Highway.directions``."""
REACHES_AHEAD = (10.0, 15.0, 20.0, 30.0, 45.0)
"""Metres that drivers of the population ``diverse`` may see ahead."""
REACHES_BEHIND = (0.0, 5.0, 15.0, 30.0, 45.0)
"""Metres that they may see behind."""
POPULATIONS = ("diverse", "paper")


def simulated_highway_drivers(
    setting: str, population: str, people: int, seed: int, device: torch.device | str = "cpu"
) -> HighwayDrivers:
    """Return the simulated drivers of a population, to be stepped by the caller.

    Args:
        setting: a setting of the world.
        population: ``paper``, sight limited by the setting alone; or ``diverse``, each with a reach
            ahead and one behind, equal in all settings.
        people: number of people P.
        seed: determines sight, consistency and caution of each.
        device: device of their tensors.

    Raises:
        UnknownNameError: there is no such setting or population.
    """
    require_known(setting, "setting", Highway.settings, Highway.name)
    require_known(population, "population", POPULATIONS, Highway.name)
    reach, consistency, caution = [], [], []
    for person in range(people):
        noise = derived_generator(seed, "highway driver", person)
        first, second = torch.randn(2, generator=noise).tolist()
        ahead, behind = (
            options[int(torch.randint(len(options), (), generator=noise))]
            for options in (REACHES_AHEAD, REACHES_BEHIND)
        )
        own = (ahead, ahead, behind, behind)
        reach.append(own if population == "diverse" else SETTING_REACH[setting])
        consistency.append(CONSISTENCY_SPREAD * first)
        caution.append(CAUTION_SPREAD * second)
    dtype = torch.get_default_dtype()
    return HighwayDrivers(
        torch.tensor(reach, dtype=dtype, device=device),
        CONSISTENCY_MEDIAN * torch.tensor(consistency, dtype=dtype, device=device).exp(),
        torch.tensor(caution, dtype=dtype, device=device).exp(),
    )


@torch.no_grad()
def best_messages(driver: HighwayDrivers, state: object, memory: object) -> Tensor:
    """Return messages ``[R, N]`` that help a driver, given all that is true: a greedy oracle.

    Only the next decision counts, and items are added one by one: the one that raises most the
    expected true value of what the driver does next, less the cost, until none does. Values are the
    expert's, of keeping up a manoeuvre in the true world.

    Args:
        driver: one person.
        state: the true states ``[1, R]``.
        memory: the driver's memories ``[1, R]``.
    """
    world = Highway()
    channels = Channels(world)
    observation = world.observe(state)  # pyright: ignore[reportArgumentType]
    values = expert.values(state)[0]  # pyright: ignore[reportArgumentType]
    allowed = channels.join(world.communicable(observation))[0]
    rounds, number = allowed.shape
    chosen = torch.zeros_like(allowed)

    def worth(flags: Tensor) -> Tensor:
        """Return the worth ``[C, R]`` of candidates ``[C, R, N]``."""
        many = len(flags)
        now = {
            name: part.expand(many, *part.shape[1:]).flatten(0, 1)[None]
            for name, part in observation.items()
        }
        before = map_state(
            lambda part: part.expand(many, *part.shape[1:]).flatten(0, 1)[None], memory
        )
        probability, _ = driver.step(before, now, channels.split(flags.flatten(0, 1)[None]))
        expected = (probability[0].view(many, rounds, -1) * values).sum(-1)
        return expected - channels.cost(flags)

    best = worth(chosen[None])[0]
    for _ in range(number):
        candidates = chosen | torch.eye(number, dtype=torch.bool, device=chosen.device)[:, None]
        usable = allowed.T & ~chosen.T
        found = torch.where(usable, worth(candidates), -torch.inf)
        most, which = found.max(0)
        better = most > best
        if not better.any():
            break
        chosen = chosen | (torch.nn.functional.one_hot(which, number).bool() & better[:, None])
        best = torch.where(better, most, best)
    return chosen


DRIVERS = DomainPeople(POPULATIONS, simulated_highway_drivers, best_messages=best_messages)
"""The drivers as registered in the world's record."""

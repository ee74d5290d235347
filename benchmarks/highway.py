"""How well the expert and the robot drive on the highway, beside random actions and nothing.

    python -m benchmarks.highway

Rounds of manoeuvres, as people drive; rounds of steering and acceleration, in the batched physics
and in the Gymnasium environment on highway-env; all from the same starts. Doing nothing is to keep
the lane at full speed, or no steering and no pedal. The robot drives by the shipped self-model,
with everything shown or shown and said; the others do not depend on what can be seen.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from torch import Tensor

from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.highway import DirectHighway, Highway, HighwayState, expert
from mirror_ppl.domains.highway.manoeuvres import SPEEDS
from mirror_ppl.domains.highway.pictures import picture
from mirror_ppl.evaluation.self_model import fixed_views
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.experience import drive

Driver = Callable[[HighwayState], Tensor]
"""Maps states to actions."""
Who = Literal["expert", "nothing", "random", "robot", "robot+said"]


@dataclass(frozen=True)
class Options:
    """What to measure."""

    rounds: int = 100
    """Rounds of each driver."""
    seed: int = 0
    """Seed of the rounds."""
    horizon: int = expert.ExpertOptions.horizon
    """Decisions that the expert looks ahead."""
    drivers: tuple[Who, ...] = ()
    """Who drives: all unless given."""
    environment: bool = True
    """Whether to play the environment on highway-env too."""
    out: Path | None = None
    """File of rows, one for each driver, scenario and simulator; none unless given."""
    picture: Path | None = None
    """File of a picture of a round; none unless given. Nothing is measured then."""


@dataclass(frozen=True)
class Played:
    """Rounds of a driver: return, whether there was an accident, and reward terms, each [B]."""

    terms: dict[str, Tensor]
    accident: Tensor
    seconds: float

    @property
    def total(self) -> Tensor:
        """Return of each round."""
        return torch.stack(list(self.terms.values())).sum(0)


Play = Callable[[Highway, HighwayState, Driver], Played]
"""Plays rounds from their starts."""


def main(options: Options) -> None:
    """Run the study."""
    torch.set_num_threads(1)
    if options.picture:
        draw(options.picture)
        return
    scenario = torch.arange(options.rounds) % len(Highway.scenarios)
    generator = torch.Generator().manual_seed(options.seed)
    start = Highway().initial(options.rounds, generator, scenario)
    noise = torch.Generator().manual_seed(options.seed + 1)
    planning = expert.ExpertOptions(options.horizon)
    direct: dict[str, Driver] = {
        "expert": lambda state: expert.act(state, planning),
        "nothing": lambda state: torch.zeros(*state.tick.shape, 2),
        "random": lambda state: torch.rand(*state.tick.shape, 2, generator=noise) * 2 - 1,
    }
    manoeuvres: dict[str, Driver] = {
        "expert": lambda state: expert.values(state, planning).argmax(-1),
        "nothing": lambda state: (state.lane[..., 0] + 1) * len(SPEEDS) - 1,
        "random": lambda state: torch.randint(
            len(Highway.actions), state.tick.shape, generator=noise
        ),
    }
    for name, speech in (("robot", False), ("robot+said", True)):
        if name in (options.drivers or (name,)):
            views = torch.Generator().manual_seed(options.seed + 2)
            manoeuvres[name] = robot(start, speech, views)
    simulators: dict[str, tuple[Highway, Play, dict[str, Driver]]] = {
        "manoeuvres": (Highway(), play_batched, manoeuvres),
        "direct": (DirectHighway(), play_batched, direct),
    }
    if options.environment:
        simulators["highway-env"] = DirectHighway(), play_environment, direct
    rows = []
    print(f"{'simulator':<12} {'driver':<10} {'return':>8} {'s.e.':>6} {'accidents':>9} {'s':>6}")
    for simulator, (world, play, drivers) in simulators.items():
        for name, driver in drivers.items():
            if options.drivers and name not in options.drivers:
                continue
            played = play(world, start, driver)
            error = played.total.std() / options.rounds**0.5
            print(
                f"{simulator:<12} {name:<10} {played.total.mean():>8.1f} {error:>6.1f} "
                f"{played.accident.double().mean():>9.0%} {played.seconds:>6.0f}",
                flush=True,
            )
            rows += rows_of(simulator, name, played, scenario, world)
    if options.out:
        with options.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


def robot(start: HighwayState, speech: bool, generator: torch.Generator) -> Driver:
    """Return the shipped self-model as a driver of rounds from these starts, step by step."""
    self_model, _ = load_self_model(shipped_weights("highway"))
    world, batch = self_model.domain, len(start.tick)
    views = fixed_views(world, batch, generator, speech=speech)
    steps = iter(drive(self_model, start, views, world.horizon, generator).unbind(1))
    return lambda state: next(steps)


def play_batched(world: Highway, start: HighwayState, driver: Driver) -> Played:
    """Play all rounds at once, by the domain's physics."""
    began, state = time.monotonic(), start
    sums: dict[str, Tensor] = {}
    for _ in range(world.horizon):
        action = driver(state)
        following = world.transition(state, action)
        for name, term in world.rewards(state, action, following).items():
            sums[name] = sums.get(name, torch.zeros(())) + term
        state = following
    return Played(sums, world.over(state), time.monotonic() - began)


def play_environment(world: Highway, start: HighwayState, driver: Driver) -> Played:
    """Play all rounds on highway-env, side by side, so that the driver decides for all at once."""
    from mirror_ppl.domains.highway import vehicles
    from mirror_ppl.domains.highway.road import TICKS

    began, batch = time.monotonic(), len(start.tick)
    roads = [vehicles.make_road(map_state(lambda part, i=i: part[i], start)) for i in range(batch)]
    ticks, state = [0] * batch, start
    sums: dict[str, Tensor] = {}
    for _ in range(world.horizon):
        action = driver(state)
        over = world.over(state)
        following = []
        for number, road in enumerate(roads):
            controls = action[number].double().numpy()
            ego = vehicles.ego_of(road)
            ego.drive(controls)
            for _ in range(TICKS):
                if not (ego.hit_others or over[number]):
                    vehicles.tick(road, ticks[number])
                    ticks[number] += 1
            following.append(vehicles.read_road(road, ticks[number], controls))
        after = map_state(lambda *parts: torch.stack(parts), *following)
        for name, term in world.rewards(state, action, after).items():
            sums[name] = sums.get(name, torch.zeros(())) + term
        state = after
    return Played(sums, world.over(state), time.monotonic() - began)


def rows_of(
    simulator: str, driver: str, played: Played, scenario: Tensor, world: Highway
) -> list[dict[str, str | float]]:
    """Return a row for each scenario."""
    rows = []
    for index, name in enumerate(world.scenarios):
        own = scenario == index
        row: dict[str, str | float] = {
            "simulator": simulator,
            "driver": driver,
            "scenario": name,
            "rounds": int(own.sum()),
            "return": round(played.total[own].mean().item(), 2),
            "accidents": round(played.accident[own].double().mean().item(), 3),
        }
        row |= {term: round(sums[own].mean().item(), 2) for term, sums in played.terms.items()}
        rows.append(row)
    return rows


def draw(path: Path) -> None:
    """Write the picture of docs/highway.md: the expert as a car cuts in, in clear and in fog."""
    from matplotlib.image import imsave

    world = DirectHighway()
    index = torch.tensor([world.scenarios.index("car on the left cuts in")])
    state = world.initial(1, torch.Generator().manual_seed(3), index)
    for _ in range(26):
        state = world.transition(state, torch.zeros(1, 2))
    one = map_state(lambda part: part[0], state)
    seen = world.observe(one)
    masks = (world.visibility(setting, seen)["visual"] for setting in world.settings)
    imsave(path, np.ascontiguousarray(picture(one, seen, *masks)))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

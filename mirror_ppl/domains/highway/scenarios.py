"""How rounds begin: traffic around the ego, and one named event that calls for a response.

Eight cars surround the ego: one in each of six directions, named by where it starts, and two far
away. All drive by the IDM and change lanes by MOBIL, except for those with a part in a scenario,
who do what it says. The left lane of an ego in the left lane is the right one: places are counted
around.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mirror_ppl.domains.highway.road import LANES, LIMIT, OTHERS, TICK, centre_of
from mirror_ppl.domains.highway.speech import DIRECTIONS, SIDES
from mirror_ppl.domains.highway.state import NEVER, HighwayState
from mirror_ppl.domains.highway.traffic import CHANGE_PERIOD

CARS = (*DIRECTIONS, "far ahead", "far behind")
"""The other vehicles, named by where they start."""
HEADWAY = 1.5
"""Seconds that cars keep to those ahead, highway-env's default."""
EGO_START = (8.5, 10.5)
"""m/s."""
Span = tuple[float, float]
"""Bounds of a uniform distribution."""


@dataclass(frozen=True)
class Car:
    """How one car starts and what it does; spans are drawn from uniformly.

    Attributes:
        ahead: metres from the ego's centre to the car's, negative behind.
        cruise: m/s that it intends, and at which it starts.
        headway: seconds that it keeps to the car ahead.
        after: seconds after which its event may begin; never by default.
        gap: metres ahead of the ego that it has to be before its event begins.
        slows: m/s that it then intends.
        lasts: seconds for which it intends this.
        cuts_in: whether it then moves to the ego's first lane.
        plays: whether it has a part in the scenario, and does not change lanes on its own.
    """

    ahead: Span
    cruise: Span = (8.5, 10.5)
    headway: float = HEADWAY
    after: Span | None = None
    gap: float = -math.inf
    slows: Span = (2.0, 4.0)
    lasts: float = 3.0
    cuts_in: bool = False
    plays: bool = True


@dataclass(frozen=True)
class Scenario:
    """Who plays a part, by the car's name, and the lanes in which the ego may start."""

    parts: Mapping[str, Car] = field(default_factory=dict)
    lanes: tuple[int, ...] = (0, 1, 2)


TRAFFIC: Mapping[str, Car] = {
    name: Car(ahead, cruise, plays=False)
    for name, ahead, cruise in (
        ("front", (30.0, 50.0), (8.5, 10.5)),
        ("front-right", (10.0, 40.0), (8.5, 11.0)),
        ("rear-right", (-45.0, -12.0), (8.5, 11.0)),
        ("rear", (-50.0, -30.0), (8.5, 10.5)),
        ("rear-left", (-45.0, -12.0), (8.5, 11.0)),
        ("front-left", (10.0, 40.0), (8.5, 11.0)),
        ("far ahead", (110.0, 140.0), (8.0, 11.0)),
        ("far behind", (-120.0, -95.0), (8.0, 11.0)),
    )
}
"""Cars that play no part."""

_BRAKES = Car((24.0, 32.0), (9.0, 10.5), after=(3.0, 8.0), slows=(1.5, 3.0), lasts=4.0)
_CUTS_IN = Car(
    (-16.0, -9.0), (14.0, 15.5), headway=0.8, after=(1.0, 3.0), gap=8.0, slows=(6.0, 8.0),
    lasts=5.0, cuts_in=True,
)  # fmt: skip
_MAKES_ROOM = Car((40.0, 55.0), (11.0, 12.0))
_FAST_BEHIND = Car((-75.0, -55.0), (15.0, 17.0), headway=0.3)
_OVERTAKES = Car((-45.0, -30.0), (15.0, 17.0), headway=0.5)
_CRAWLS = Car((70.0, 90.0), (1.5, 3.0))
_SLOW_AHEAD = Car((35.0, 45.0), (5.0, 6.5))
_LEFT, _RIGHT = (1, 2), (0, 1)

SCENARIOS: Mapping[str, Scenario] = {
    "calm traffic": Scenario(),
    "car ahead brakes": Scenario({"front": _BRAKES}),
    "car ahead crawls": Scenario({"front": _CRAWLS}),
    "car on the left cuts in": Scenario({"rear-left": _CUTS_IN, "front-left": _MAKES_ROOM}, _LEFT),
    "car on the right cuts in": Scenario(
        {"rear-right": _CUTS_IN, "front-right": _MAKES_ROOM}, _RIGHT
    ),
    "fast car behind": Scenario({"rear": _FAST_BEHIND}),
    "fast car on the left, slow one ahead": Scenario(
        {"rear-left": _OVERTAKES, "front-left": _MAKES_ROOM, "front": _SLOW_AHEAD}, _LEFT
    ),
    "fast car on the right, slow one ahead": Scenario(
        {"rear-right": _OVERTAKES, "front-right": _MAKES_ROOM, "front": _SLOW_AHEAD}, _RIGHT
    ),
    "braking ahead, fast car behind": Scenario({"front": _BRAKES, "rear": _FAST_BEHIND}),
}
NAMES = tuple(SCENARIOS)


def initial(scenario: Tensor, generator: torch.Generator) -> HighwayState:
    """Draw states ``[B]`` at the start of a round.

    Args:
        scenario: index ``[B]`` of each round's scenario.
        generator: of randomness, on the device of the states.
    """
    batch, device, dtype = len(scenario), generator.device, torch.get_default_dtype()
    table = _Table.of(device)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(batch, *shape, generator=generator, device=device)

    def between(spans: Tensor, ego: Span) -> Tensor:
        """Return draws ``[B, 1 + OTHERS]`` for the ego and the cars."""
        own = torch.tensor(ego, device=device).expand(batch, 1, 2)
        low, high = torch.cat([own, spans[scenario]], 1).unbind(-1)
        return low + (high - low) * uniform(1 + OTHERS)

    def with_ego(value: float, others: Tensor) -> Tensor:
        return torch.cat([others.new_full((batch, 1), value), others[scenario]], 1)

    lanes = table.ego_lanes[scenario]
    first = (uniform() * lanes[:, 0]).long().clamp(max=LANES - 1)
    first = lanes[:, 1:].gather(1, first[:, None])
    far = (uniform(2) * LANES).long().clamp(max=LANES - 1)
    beside = (first + torch.tensor(SIDES, device=device)) % LANES
    lane = torch.cat([first, beside, far], 1)

    x = between(table.ahead, (0.0, 0.0))
    speed = between(table.cruise, EGO_START)
    cruise = torch.cat([torch.full_like(speed[:, :1], LIMIT), speed[:, 1:]], 1)
    acts = with_ego(0.0, table.acts) > 0
    at = (between(table.after, (0.0, 0.0)) / TICK).long()
    timer = (uniform(1 + OTHERS) * CHANGE_PERIOD).long().clamp(max=CHANGE_PERIOD - 1)
    cuts_in = with_ego(0.0, table.cuts_in) > 0
    ticks = torch.zeros(batch, dtype=torch.long, device=device)
    return HighwayState(
        x=x,
        y=centre_of(lane).to(dtype),
        heading=torch.zeros_like(x),
        speed=speed,
        acceleration=torch.zeros_like(x),
        target_lane=lane,
        cruise=cruise,
        headway=with_ego(HEADWAY, table.headway),
        changes=with_ego(0.0, table.changes) > 0,
        timer=timer,
        cue_at=torch.where(acts, at, NEVER),
        cue_gap=with_ego(0.0, table.gap),
        cue_lane=torch.where(cuts_in, first, lane),
        cue_speed=between(table.slows, (0.0, 0.0)),
        cue_for=(with_ego(0.0, table.lasts) / TICK).round().long(),
        begun=torch.full_like(lane, NEVER),
        controls=x.new_zeros(batch, 2),
        tick=ticks,
        crashed=ticks > 0,
    )


@dataclass(frozen=True)
class _Table:
    """The cars of all scenarios: spans ``[scenarios, OTHERS, 2]``, numbers without the 2.

    ``ego_lanes`` ``[scenarios, 1 + LANES]`` holds the number of lanes in which the ego may start,
    and these lanes.
    """

    ahead: Tensor
    cruise: Tensor
    after: Tensor
    slows: Tensor
    headway: Tensor
    gap: Tensor
    lasts: Tensor
    acts: Tensor
    cuts_in: Tensor
    changes: Tensor
    ego_lanes: Tensor

    @classmethod
    def of(cls, device: torch.device) -> _Table:
        cars = [[s.parts.get(name, TRAFFIC[name]) for name in CARS] for s in SCENARIOS.values()]

        def table(value) -> Tensor:
            rows = [[value(car) for car in row] for row in cars]
            return torch.tensor(rows, dtype=torch.get_default_dtype(), device=device)

        return cls(
            ahead=table(lambda car: car.ahead),
            cruise=table(lambda car: car.cruise),
            after=table(lambda car: car.after or (0.0, 0.0)),
            slows=table(lambda car: car.slows),
            headway=table(lambda car: car.headway),
            gap=table(lambda car: car.gap),
            lasts=table(lambda car: car.lasts),
            acts=table(lambda car: float(car.after is not None)),
            cuts_in=table(lambda car: float(car.cuts_in)),
            changes=table(lambda car: float(not car.plays)),
            ego_lanes=torch.tensor(
                [
                    [len(s.lanes), *s.lanes, *[0] * (LANES - len(s.lanes))]
                    for s in SCENARIOS.values()
                ],
                device=device,
            ),
        )

"""Rounds as highway-env's own road and vehicles, and back as states.

highway-env is an optional dependency, ``pip install 'mirror_ppl[highway]'``; only this module and
the environment import it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

# highway-env asks pygame not to greet on import only after it was imported.
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

import numpy as np
import torch

try:
    from highway_env.road.road import Road, RoadNetwork
    from highway_env.vehicle.behavior import IDMVehicle
    from highway_env.vehicle.kinematics import Vehicle
except ImportError as error:
    message = "the environment needs highway-env: pip install 'mirror_ppl[highway]'"
    raise ImportError(message) from error

from mirror_ppl.domains.highway.road import (
    EGO_SPEEDS,
    LANES,
    MAX_ACCELERATION,
    MAX_STEERING,
    TICK,
)
from mirror_ppl.domains.highway.state import NEVER, HighwayState
from mirror_ppl.domains.highway.traffic import ROAD_LIMIT

ORIGIN = 1000.0
"""``x`` in highway-env of a state's ``x = 0``: cars behind it have to be on its road, too."""
_EARLY = 1e-6
"""Seconds that timers go fast, so that sums of ticks reach a whole second for certain."""
_CAR = ("cue_at", "cue_gap", "cue_lane", "cue_speed", "cue_for", "begun", "cruise")


class Ego(Vehicle):
    """The person's car: driven by what they do; collisions with it are noticed, nothing more."""

    MIN_SPEED, MAX_SPEED = EGO_SPEEDS

    def __init__(self, road: Road, position: Sequence[float], heading: float, speed: float) -> None:
        super().__init__(road, position, heading, speed)
        self.target_speed = 0.0
        self.hit_others = False

    def drive(self, action: np.ndarray) -> None:
        """Steer and accelerate, until the next call, by an action in [-1, 1]."""
        steering, acceleration = np.clip(np.asarray(action, np.float64), -1, 1)
        self.act(
            {"steering": steering * MAX_STEERING, "acceleration": acceleration * MAX_ACCELERATION}
        )

    def handle_collisions(self, other: Vehicle, dt: float = 0) -> None:
        """Remember whether the other vehicle is touched; no impact moves anybody."""
        self.hit_others = self.hit_others or self._is_colliding(other, dt)[0]


class Car(IDMVehicle):
    """Another vehicle: highway-env's IDM and MOBIL, and one event of a scenario."""

    def __init__(self, road: Road, position: Sequence[float], heading: float, speed: float) -> None:
        super().__init__(road, position, heading, speed)
        self.check_collisions = False  # as in highway-env's fast environment
        self.cue_at = self.begun = NEVER
        self.cue_gap, self.cue_lane, self.cue_speed, self.cue_for = 0.0, 0, 0.0, 0
        self.cruise = speed

    def cue(self, now: int, ego: Ego) -> None:
        """Begin the event if it is time, and intend the speed that holds at tick ``now``."""
        ahead = self.position[0] - ego.position[0]
        if self.begun == NEVER and now >= self.cue_at and ahead >= self.cue_gap:
            self.begun = now
            self.target_lane_index = (*self.lane_index[:2], self.cue_lane)
        under_way = 0 <= now - self.begun < self.cue_for
        self.target_speed = self.cue_speed if under_way else self.cruise


def make_road(state: HighwayState) -> Road:
    """Return a state without batch as a road with vehicles; the ego comes first."""
    road = Road(RoadNetwork.straight_road_network(LANES, speed_limit=ROAD_LIMIT))
    parts = {name: part.tolist() for name, part in vars(state).items()}
    intended = state.intended.tolist()
    for number in range(len(parts["x"])):
        own = {
            name: part[number]
            for name, part in parts.items()
            if isinstance(part, list) and name != "controls"
        }
        where = (own["x"] + ORIGIN, own["y"])
        kind = Car if number else Ego
        vehicle = kind(road, where, own["heading"], own["speed"])
        vehicle.action = {"steering": 0.0, "acceleration": own["acceleration"]}
        if isinstance(vehicle, Car):
            for name in _CAR:
                setattr(vehicle, name, own[name])
            vehicle.target_speed = intended[number]
            vehicle.target_lane_index = (*vehicle.lane_index[:2], own["target_lane"])
            vehicle.TIME_WANTED = own["headway"]
            vehicle.enable_lane_change = own["changes"]
            vehicle.timer = own["timer"] * TICK + _EARLY
        else:
            vehicle.target_speed = own["cruise"]
            vehicle.hit_others = bool(parts["crashed"])
        road.vehicles.append(vehicle)
    return road


def tick(road: Road, now: int) -> None:
    """Let highway-env play one tick of physics.

    Args:
        road: as from `make_road`.
        now: ticks since the round began.
    """
    ego = ego_of(road)
    for car in cars_of(road):
        car.cue(now, ego)
    road.act()
    road.step(TICK)


def ego_of(road: Road) -> Ego:
    """Return the person's car."""
    ego = road.vehicles[0]
    assert isinstance(ego, Ego)
    return ego


def cars_of(road: Road) -> list[Car]:
    """Return the other vehicles."""
    return [car for car in road.vehicles if isinstance(car, Car)]


def read_road(
    road: Road, now: int, controls: np.ndarray, dtype: torch.dtype | None = None
) -> HighwayState:
    """Return a road as a state without batch; undoes `make_road`.

    Args:
        road: as from `make_road`.
        now: ticks since the round began.
        controls: the ego's last action ``[2]``.
        dtype: of numbers; torch's default unless given.
    """
    dtype = dtype or torch.get_default_dtype()
    ego, cars = ego_of(road), cars_of(road)
    everybody = [ego, *cars]

    def numbers(values: list[float]) -> torch.Tensor:
        return torch.tensor(values, dtype=dtype)

    def whole(values: list[int]) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.long)

    lane = ego.lane_index[2]
    return HighwayState(
        x=numbers([v.position[0] - ORIGIN for v in everybody]),
        y=numbers([v.position[1] for v in everybody]),
        heading=numbers([v.heading for v in everybody]),
        speed=numbers([v.speed for v in everybody]),
        acceleration=numbers([v.action["acceleration"] for v in everybody]),
        target_lane=whole([lane, *(v.target_lane_index[2] for v in cars)]),
        cruise=numbers([ego.target_speed, *(v.cruise for v in cars)]),
        headway=numbers([IDMVehicle.TIME_WANTED, *(v.TIME_WANTED for v in cars)]),
        changes=torch.tensor([False, *(v.enable_lane_change for v in cars)]),
        timer=whole([0, *(round(v.timer / TICK) for v in cars)]),
        cue_at=whole([NEVER, *(v.cue_at for v in cars)]),
        cue_gap=numbers([0.0, *(v.cue_gap for v in cars)]),
        cue_lane=whole([lane, *(v.cue_lane for v in cars)]),
        cue_speed=numbers([0.0, *(v.cue_speed for v in cars)]),
        cue_for=whole([0, *(v.cue_for for v in cars)]),
        begun=whole([NEVER, *(v.begun for v in cars)]),
        controls=torch.as_tensor(np.asarray(controls, np.float64)).to(dtype),
        tick=torch.tensor(now),
        crashed=torch.tensor(ego.hit_others),
    )

"""Highway driving in CARLA: its vehicles as states, with the same observations and rewards.

**Untested against a server.** Tests play it against a fake client that has the calls used here,
written after CARLA's Python API 0.9.15. The client's package is given by whoever has it::

    import carla
    from mirror_ppl.domains.highway.carla import CarlaEnv

    client = carla.Client(host, 2000)
    env = CarlaEnv(carla, client, spawn, setting="fog")

``spawn(client, scenario, seed)`` places the ego and the traffic on a road of three lanes, sets the
weather, and returns the ego; CARLA's own traffic manager moves the others.

How CARLA's world becomes a state
    - Coordinates follow the road: the frame is that of the lane at the ego, so that gentle bends
      count as straight. CARLA's y points to the right too, so nothing is mirrored.
    - Lanes have any width there; across the road metres are stretched to 4 m a lane.
    - Vehicles count as 5 m by 2 m. The nearest eight are in the state; missing ones are far away.
      Vehicles beside the three lanes and their shoulders, as oncoming traffic, are left out.
    - What others intend is not known: their intended speed is the one they have, and nobody has a
      scripted event. A planner that uses such states foresees less than with highway-env.
    - Acceleration in [-1, 1] is throttle or brake, which is not the same as m/s2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from mirror_ppl.domains.highway.lidar import RANGE
from mirror_ppl.domains.highway.road import (
    LANE_WIDTH,
    LANES,
    LEFT_EDGE,
    LIMIT,
    MAX_STEERING,
    OTHERS,
    RIGHT_EDGE,
    SHOULDER,
    TICK,
    TICKS,
    WIDTH,
    lane_of,
    wrapped,
)
from mirror_ppl.domains.highway.rounds import RoundEnv
from mirror_ppl.domains.highway.scenarios import HEADWAY
from mirror_ppl.domains.highway.state import NEVER, HighwayState

Spawn = Callable[[Any, str, int], Any]
"""Places vehicles, given client, scenario's name and seed; returns the ego's actor."""
AWAY = 10 * RANGE
"""Metres ahead at which missing vehicles are."""
LEFTMOST = LEFT_EDGE - SHOULDER + WIDTH / 2
RIGHTMOST = RIGHT_EDGE + SHOULDER - WIDTH / 2
"""``y`` in metres between which vehicles are on the road or its shoulders, with their whole width.

The next lane beyond a shoulder has its centre a metre further out.
"""


class CarlaEnv(RoundEnv):
    """Rounds of :class:`~mirror_ppl.domains.highway.environment.HighwayEnv` played in CARLA.

    Args:
        carla: CARLA's Python module.
        client: a connected ``carla.Client``.
        spawn: see the module's description.
        setting: "clear" or "fog"; what is masked. The weather is up to ``spawn``.
        scenario: name of a scenario, given to ``spawn``; a random one in each round unless given.
        render_mode: "rgb_array" or None.

    Raises:
        UnknownNameError: if the setting, the scenario or the render mode is not a known one.
    """

    def __init__(
        self,
        carla: Any,
        client: Any,
        spawn: Spawn,
        setting: str | None = None,
        scenario: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(setting, scenario, render_mode)
        self._carla, self._client, self._spawn = carla, client, spawn
        self._ego: Any = None
        self._sensor: Any = None
        self._synchronous = False

    def begin(self, scenario: int, seed: int) -> None:
        """Let ``spawn`` place vehicles, with physics at 20 Hz that waits for us."""
        self._remove_sensor()
        self._wait(True)
        world = self._client.get_world()
        self._ego = self._spawn(self._client, self.domain.scenarios[scenario], seed)
        blueprint = world.get_blueprint_library().find("sensor.other.collision")
        transform = self._carla.Transform()
        self._sensor = world.spawn_actor(blueprint, transform, attach_to=self._ego)
        self._sensor.listen(self._hit)
        wheels = self._ego.get_physics_control().wheels
        self._most = math.radians(max(wheel.max_steer_angle for wheel in wheels))
        self._controls, self._tick, self._crashed = np.zeros(2), 0, False
        world.tick()

    def advance(self, action: np.ndarray) -> None:
        """Hold throttle or brake and the steering wheel for four ticks."""
        self._controls = action.astype(np.float64)
        steering, acceleration = (float(part) for part in action)
        self._ego.apply_control(
            self._carla.VehicleControl(
                throttle=max(acceleration, 0.0),
                brake=max(-acceleration, 0.0),
                steer=steering * MAX_STEERING / self._most,
            )
        )
        for _ in range(TICKS):
            if not self._crashed:
                self._client.get_world().tick()
                self._tick += 1

    def simulated(self) -> HighwayState:
        """Return CARLA's vehicles as a state."""
        world = self._client.get_world()
        others = [a for a in world.get_actors().filter("vehicle.*") if a.id != self._ego.id]
        lane = world.get_map().get_waypoint(self._ego.get_location())
        rows = torch.tensor([_row(actor, lane) for actor in (self._ego, *others)])
        on_road = (rows[:, 1] >= LEFTMOST) & (rows[:, 1] <= RIGHTMOST)
        on_road[0] = True  # the ego may have left the road
        rows = rows[on_road]
        order = rows[1:, 0].hypot(rows[1:, 1] - rows[0, 1]).argsort()[:OTHERS]
        rows = torch.cat([rows[:1], rows[1:][order]])
        missing = OTHERS + 1 - len(rows)
        away = torch.zeros(missing, rows.shape[1])
        away[:, 0] = AWAY
        x, y, heading, speed, acceleration = torch.cat([rows, away]).unbind(-1)
        lanes, zeros = lane_of(y), torch.zeros(len(x), dtype=torch.long)
        return HighwayState(
            x=x,
            y=y,
            heading=wrapped(heading),
            speed=speed,
            acceleration=acceleration,
            target_lane=lanes,
            cruise=torch.cat([x.new_tensor([LIMIT]), speed[1:]]),
            headway=torch.full_like(x, HEADWAY),
            changes=zeros > 0,
            timer=zeros,
            cue_at=zeros + NEVER,
            cue_gap=torch.zeros_like(x),
            cue_lane=lanes,
            cue_speed=torch.zeros_like(x),
            cue_for=zeros,
            begun=zeros + NEVER,
            controls=torch.from_numpy(self._controls).to(x.dtype),
            tick=torch.tensor(self._tick),
            crashed=torch.tensor(self._crashed),
        )

    def close(self) -> None:
        """Remove the collision sensor and let the server run by itself; vehicles stay."""
        self._remove_sensor()
        if self._synchronous:
            self._wait(False)

    def _wait(self, waits: bool) -> None:
        """Set whether the server waits for our ticks, of 1/20 s, or runs by itself."""
        world = self._client.get_world()
        settings = world.get_settings()
        settings.synchronous_mode = waits
        settings.fixed_delta_seconds = TICK if waits else None
        world.apply_settings(settings)
        self._synchronous = waits

    def _remove_sensor(self) -> None:
        if self._sensor is not None:
            self._sensor.stop()
            self._sensor.destroy()
            self._sensor = None

    def _hit(self, event: Any) -> None:
        del event
        self._crashed = True


def _row(actor: Any, lane: Any) -> tuple[float, float, float, float, float]:
    """Return x, y, heading, speed and acceleration of an actor along the road at the ego.

    Args:
        actor: a vehicle.
        lane: CARLA's waypoint of the ego's lane; ``x`` is 0 there.
    """
    place, yaw = actor.get_location(), math.radians(lane.transform.rotation.yaw)
    middle = lane.transform.location
    cos, sin = math.cos(yaw), math.sin(yaw)

    def turned(east: float, south: float) -> tuple[float, float]:
        return cos * east + sin * south, cos * south - sin * east

    along, across = turned(place.x - middle.x, place.y - middle.y)
    heading = math.radians(actor.get_transform().rotation.yaw) - yaw
    nose = math.cos(heading), math.sin(heading)
    velocity, push = actor.get_velocity(), actor.get_acceleration()
    speed, acceleration = (
        sum(part * way for part, way in zip(turned(vector.x, vector.y), nose, strict=True))
        for vector in (velocity, push)
    )
    y = (_lane_number(lane) + across / lane.lane_width) * LANE_WIDTH
    return along, y, heading, speed, acceleration


def _lane_number(lane: Any) -> int:
    """Return how many lanes of the same direction are to the left of a lane."""
    count, left = 0, lane.get_left_lane()
    while left is not None and left.lane_id * lane.lane_id > 0 and _drivable(left):
        count, left = count + 1, left.get_left_lane()
    return min(count, LANES - 1)


def _drivable(lane: Any) -> bool:
    return str(lane.lane_type).endswith("Driving")

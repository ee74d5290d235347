"""The adapter to CARLA against a fake client with a road that runs in any direction."""

import math
from types import SimpleNamespace as Some

import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded

from mirror_ppl.domains.highway import DirectHighway
from mirror_ppl.domains.highway.carla import CarlaEnv
from mirror_ppl.domains.highway.road import MAX_STEERING, OTHERS, TICK, TICKS

WIDTH = 3.5
STEEPEST = 70.0


class Actor:
    """A vehicle; the ego goes on as its control says, in a straight line."""

    def __init__(self, world, along, lane, speed, acceleration=0.0):
        self.world, self.along, self.lane = world, along, lane
        self.speed, self.acceleration = speed, acceleration
        self.id, self.control = len(world.actors), None
        world.actors.append(self)

    def turned(self, along, across=0.0):
        yaw = self.world.yaw
        x = along * math.cos(yaw) - across * math.sin(yaw)
        return Some(x=x, y=along * math.sin(yaw) + across * math.cos(yaw), z=0.0)

    def get_location(self):
        return self.turned(self.along, self.lane * WIDTH)

    def get_transform(self):
        yaw = math.degrees(self.world.yaw)
        return Some(location=self.get_location(), rotation=Some(yaw=yaw))

    def get_velocity(self):
        return self.turned(self.speed)

    def get_acceleration(self):
        return self.turned(self.acceleration)

    def get_physics_control(self):
        return Some(wheels=[Some(max_steer_angle=STEEPEST), Some(max_steer_angle=0.0)])

    def apply_control(self, control):
        self.control = control


class Sensor:
    def __init__(self, world):
        self.world = world

    def listen(self, callback):
        self.world.on_collision = callback

    def stop(self):
        self.world.on_collision = None

    def destroy(self):
        self.world.sensors.remove(self)


class World:
    """CARLA's world, map and client at once."""

    def __init__(self, yaw):
        self.yaw, self.actors, self.sensors, self.ticks = yaw, [], [], 0
        self.on_collision, self.settings = None, Some(synchronous_mode=False)

    def get_world(self):
        return self

    def get_map(self):
        return self

    def get_settings(self):
        return self.settings

    def apply_settings(self, settings):
        self.settings = settings

    def get_blueprint_library(self):
        return Some(find=lambda name: name)

    def spawn_actor(self, blueprint, transform, attach_to):
        assert blueprint == "sensor.other.collision" and attach_to is self.actors[0]
        self.sensors.append(Sensor(self))
        return self.sensors[-1]

    def get_actors(self):
        return Some(filter=lambda pattern: list(self.actors) if pattern == "vehicle.*" else [])

    def get_waypoint(self, location):
        across = -location.x * math.sin(self.yaw) + location.y * math.cos(self.yaw)
        return self.lane(round(across / WIDTH), location)

    def lane(self, number, location):
        along = location.x * math.cos(self.yaw) + location.y * math.sin(self.yaw)
        middle = self.actors[0].turned(along, number * WIDTH)
        # Beyond the left lane there is one of the other direction.
        kind, lane_id = "LaneType.Driving", -(number + 1) if number >= 0 else 1
        return Some(
            transform=Some(location=middle, rotation=Some(yaw=math.degrees(self.yaw))),
            lane_width=WIDTH,
            lane_type=kind,
            lane_id=lane_id,
            get_left_lane=lambda: self.lane(number - 1, location),
        )

    def tick(self):
        self.ticks += 1
        for actor in self.actors:
            actor.along += actor.speed * TICK
        ego = self.actors[0]
        if any(abs(a.along - ego.along) < 5 and a.lane == ego.lane for a in self.actors[1:]):
            self.on_collision(Some())


CARLA = Some(Transform=Some, VehicleControl=Some)


def made(yaw=0.0, cars=((30.0, 1.0, 8.0), (-12.0, 2.0, 14.0)), lane=1.2, **options):
    world = World(yaw)
    asked = []

    def spawn(client, scenario, seed):
        asked.append((client, scenario, seed))
        client.actors.clear()
        ego = Actor(client, 5.0, lane, 10.0)
        for along, place, speed in cars:
            Actor(client, 5.0 + along, place, speed, acceleration=-3.0)
        return ego

    return CarlaEnv(CARLA, world, spawn, **options), world, asked


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_states_follow_the_road(yaw):
    env, world, asked = made(yaw, scenario="calm traffic")
    env.reset(seed=3)
    assert world.settings.synchronous_mode and world.settings.fixed_delta_seconds == TICK
    assert asked[0][:2] == (world, "calm traffic")
    state = env.state
    # One tick was played to begin with; the nearest car comes first.
    assert state.x[:3].tolist() == pytest.approx([0.0, -12 + 4 * TICK, 30 - 2 * TICK], abs=1e-4)
    assert state.y[:3].tolist() == pytest.approx([4.8, 8.0, 4.0], abs=1e-4)
    assert state.heading[:3].tolist() == pytest.approx([0.0] * 3, abs=1e-5)
    assert state.speed[:3].tolist() == pytest.approx([10.0, 14.0, 8.0], abs=1e-4)
    assert state.acceleration[:3].tolist() == pytest.approx([0.0, -3.0, -3.0], abs=1e-4)
    assert state.lane[:3].tolist() == [1, 2, 1]
    assert len(state.x) == 1 + OTHERS and (state.x[3:] > 500).all()


def test_observations_and_rewards_are_the_domain_s():
    env, _, _ = made(setting="fog")
    observed, info = env.reset(seed=0)
    before, domain = env.state, DirectHighway()
    values = domain.observe(before)
    seen = domain.visibility("fog", values)["visual"]
    assert observed["visual_mask"].tolist() == seen.int().tolist()
    assert observed in env.observation_space
    action = np.array([0.5, -0.25], np.float32)
    _, reward, terminated, truncated, info = env.step(action)
    terms = domain.rewards(before, torch.from_numpy(action), env.state)
    assert info["rewards"] == {name: term.item() + 0.0 for name, term in terms.items()}
    assert reward == pytest.approx(sum(info["rewards"].values()))
    assert not terminated and not truncated and info["state"]["tick"] == TICKS


@pytest.mark.parametrize(("push", "throttle", "brake"), [(0.6, 0.6, 0.0), (-0.4, 0.0, 0.4)])
def test_controls(push, throttle, brake):
    env, world, _ = made()
    env.reset(seed=0)
    env.step(np.array([0.5, push], np.float32))
    control = world.actors[0].control
    assert (control.throttle, control.brake) == pytest.approx((throttle, brake))
    assert control.steer == pytest.approx(0.5 * MAX_STEERING / math.radians(STEEPEST))
    assert world.ticks == 1 + TICKS


def test_a_collision_ends_the_round_and_the_next_one_begins_anew():
    env, world, asked = made(cars=[(6.0, 1.0, 2.0)], lane=1.0)
    env.reset(seed=0)
    *_, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert terminated and not truncated and info["rewards"]["accident"] == -100
    assert info["state"]["tick"] < TICKS
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(2, np.float32))
    env.reset(seed=0)
    assert asked[0][1:] == asked[1][1:]  # the same seed, the same round
    assert len(world.sensors) == 1 and not env.state.crashed
    env.close()
    assert not world.sensors
    assert not world.settings.synchronous_mode and world.settings.fixed_delta_seconds is None
    world.settings = Some(synchronous_mode=True)  # by another client
    env.close()
    assert world.settings.synchronous_mode


def test_only_the_nearest_vehicles_are_in_the_state():
    cars = [(15.0 * k, k % 3, 9.0) for k in range(1, OTHERS + 4)]
    env, _, _ = made(cars=cars)
    env.reset(seed=0)
    ahead = sorted(env.state.x[1:].tolist())
    assert ahead == pytest.approx([15.0 * k - 0.05 for k in range(1, OTHERS + 1)], abs=1e-3)


def test_only_vehicles_on_the_road_are_in_the_state():
    aside = [(3.0 * k, place, -9.0) for k, place in enumerate((-1.0, -1.1, 3.0, 4.0, -2.0) * 2)]
    road = [(40.0, 0.0, 9.0), (45.0, 2.6, 9.0), (50.0, -0.6, 9.0)]  # the last on the shoulders
    env, _, _ = made(cars=[*aside, *road])
    env.reset(seed=0)
    there = env.state.x[1:] < 500
    assert env.state.y[1:][there].tolist() == pytest.approx([0.0, 10.4, -2.4], abs=1e-4)
    assert env.state.lane[1:][there].tolist() == [0, 2, 0]

"""The batched physics against highway-env's own vehicles: accelerations, steering, whole rounds."""

from dataclasses import replace

import pytest
import torch

pytest.importorskip("highway_env", reason="highway-env is not installed (mirror_ppl[highway])")

from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_states import state_of

from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.highway import traffic, vehicles
from mirror_ppl.domains.highway.geometry import overlap
from mirror_ppl.domains.highway.road import LANES, OTHERS, TICK, TICKS, centre_of
from mirror_ppl.domains.highway.world import DirectHighway

WORLD = DirectHighway()
FIELDS = ("x", "y", "heading", "speed", "acceleration", "target_lane", "timer", "begun", "crashed")
FIVE_SECONDS = 25


@pytest.fixture
def double():
    """Torch's default numbers are highway-env's."""
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(default)


def anything(generator, batch=40):
    """States that no round leads to: vehicles anywhere, at any angle, on their way anywhere."""

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(batch, *shape, generator=generator)

    number = 1 + OTHERS
    state = WORLD.initial(batch, generator)
    target = (uniform(0, LANES, number)).long()
    return replace(
        state,
        x=uniform(-60, 60, number),
        y=uniform(-3, 11, number),
        heading=uniform(-0.4, 0.4, number),
        speed=uniform(0.5, 18, number),
        cruise=uniform(2, 20, number),
        headway=uniform(0.2, 2, number),
        target_lane=target,
    )


def test_bicycle_model(generator, double):
    state = anything(generator)
    steering = torch.rand(state.x.shape, generator=generator) * 2 - 1
    acceleration = torch.rand(state.x.shape, generator=generator) * 12 - 6
    moved = traffic.bicycle(state, steering, acceleration)
    for row in range(len(state.x)):
        road = vehicles.make_road(map_state(lambda part, row=row: part[row], state))
        for number, vehicle in enumerate(road.vehicles):
            vehicle.action = {
                "steering": steering[row, number].item(),
                "acceleration": acceleration[row, number].item(),
            }
            Vehicle.step(vehicle, TICK)
            found = [*vehicle.position, vehicle.heading, vehicle.speed]
            expected = [getattr(moved, name)[row, number].item() for name in FIELDS[:4]]
            expected[0] += vehicles.ORIGIN
            assert found == pytest.approx(expected, abs=1e-5, rel=0)


def test_idm_and_steering(generator, double):
    state = replace(anything(generator), changes=torch.zeros(40, 1 + OTHERS, dtype=torch.bool))
    acceleration = traffic.followed(traffic.Flow.of(state))
    steering = traffic.steer_to(traffic.Flow.of(state), centre_of(state.target_lane))
    behind_somebody = 0
    for row in range(len(state.x)):
        road = vehicles.make_road(map_state(lambda part, row=row: part[row], state))
        for number, car in enumerate(road.vehicles[1:], start=1):
            car.cue(0, vehicles.ego_of(road))
            IDMVehicle.act(car)
            assert car.action["acceleration"] == pytest.approx(
                acceleration[row, number].item(), abs=1e-5, rel=0
            )
            assert car.action["steering"] == pytest.approx(
                steering[row, number].item(), abs=1e-5, rel=0
            )
            behind_somebody += road.neighbour_vehicles(car)[0] is not None
    assert behind_somebody > 200


def test_lane_changes(generator, double):
    """MOBIL and changes that are given up, one decision from anywhere; many of each happen."""
    number = 1 + OTHERS
    state = anything(generator, 150)
    changes = torch.ones_like(state.changes)
    changes[:, 0] = False
    state = replace(state, changes=changes, timer=torch.full((150, number), 20))
    here = state.lane == state.target_lane
    chosen = traffic.change_lanes(traffic.Flow.of(state), changes, changes & here)
    begun = given_up = 0
    for row in range(len(state.x)):
        road = vehicles.make_road(map_state(lambda part, row=row: part[row], state))
        for place, car in enumerate(road.vehicles[1:], start=1):
            kept = [other.target_lane_index for other in road.vehicles[1:]]
            car.change_lane_policy()
            assert car.target_lane_index[2] == chosen[row, place], (row, place)
            begun += bool(here[row, place]) and car.target_lane_index[2] != car.lane_index[2]
            given_up += not here[row, place] and car.target_lane_index[2] == car.lane_index[2]
            # What one decides is not known to the next within a tick, see the module.
            for other, lane in zip(road.vehicles[1:], kept, strict=True):
                other.target_lane_index = lane
    assert begun > 50 and given_up > 50


def test_collisions(generator, double):
    state = anything(generator, 300)
    boxes = torch.stack([state.x / 8, state.y, state.heading], -1)
    touching = overlap(boxes[:, :1], boxes[:, 1:])
    assert 0.1 < touching.double().mean() < 0.9
    for row in range(len(state.x)):
        near = replace(map_state(lambda part, row=row: part[row], state), x=boxes[row, :, 0])
        ego, *cars = vehicles.make_road(near).vehicles
        assert [ego._is_colliding(car, 0.0)[0] for car in cars] == touching[row].tolist()


def both(state, actions, dtype):
    """Play actions here and in highway-env; yield both states after each decision."""
    road, now = vehicles.make_road(state), 0
    for action in actions:
        state = WORLD.transition(state, action.to(dtype))
        vehicles.ego_of(road).drive(action.numpy())
        for _ in range(TICKS):
            if not vehicles.ego_of(road).hit_others:
                vehicles.tick(road, now)
                now += 1
        yield state, vehicles.read_road(road, now, action.numpy(), dtype)


def differences(ours, theirs):
    """Largest difference of each field; what the ego intends is nobody's."""
    return {
        name: (getattr(ours, name).double() - getattr(theirs, name).double())
        .abs()[..., 1 if name in ("target_lane", "timer") else 0 :]
        .max()
        .item()
        if getattr(ours, name).dim()
        else float(getattr(ours, name) != getattr(theirs, name))
        for name in FIELDS
    }


@pytest.mark.parametrize("scenario", range(len(WORLD.scenarios)))
def test_five_seconds(scenario, generator, double):
    """Every position, speed, lane and timer within 1e-6 of highway-env's, at each decision."""
    start = map_state(lambda part: part[0], WORLD.initial(1, generator, torch.tensor([scenario])))
    actions = torch.rand(FIVE_SECONDS, 2, generator=generator) - 0.5
    actions[:, 0] *= 0.1
    for ours, theirs in both(start, actions, torch.float64):
        found = differences(ours, theirs)
        assert max(found.values()) < 1e-6, found


def test_five_seconds_with_numbers_of_32_bits(generator):
    """Within 2 cm and 2 cm/s, of 100 m driven: what rounding adds up to."""
    start = map_state(lambda part: part[0], WORLD.initial(1, generator, torch.tensor([1])))
    actions = torch.rand(FIVE_SECONDS, 2, generator=generator) - 0.5
    actions[:, 0] *= 0.1
    for ours, theirs in both(start, actions, torch.float32):
        found = differences(ours, theirs)
        assert max(found[name] for name in FIELDS[:4]) < 0.02, found
        assert found["target_lane"] == found["begun"] == found["timer"] == 0


def test_other_cars_pass_through_one_another(double):
    """One moves into the car beside it; neither stops, here or there."""
    start = state_of((-80.0, 8.0, 0.0, 10.0), [(0.0, 0.0, 0.0, 10.0), (1.0, 4.0, 0.0, 10.0)])
    target = start.target_lane.clone()
    target[1] = 1
    met = False
    for ours, theirs in both(replace(start, target_lane=target), torch.zeros(15, 2), torch.float64):
        assert max(differences(ours, theirs).values()) < 1e-6
        boxes = torch.stack([ours.x, ours.y, ours.heading], -1)
        met = met or overlap(boxes[1], boxes[2]).item()
    assert met


def test_a_collision_here_is_one_there(double):
    start = state_of((0.0, 4.0, 0.0, 12.0), [(12.0, 4.0, 0.0, 0.5)])
    *_, (ours, theirs) = both(start, torch.zeros(5, 2), torch.float64)
    assert ours.crashed and theirs.crashed and ours.tick == theirs.tick


def test_a_state_is_read_back_as_it_was_made(generator, double):
    for _ in range(5):
        state = map_state(lambda part: part[0], WORLD.initial(1, generator))
        back = vehicles.read_road(vehicles.make_road(state), 0, state.controls.numpy())
        for name, part in vars(state).items():
            own = part[1:] if part.dim() and name not in ("controls", "x", "y") else part
            theirs = getattr(back, name)
            theirs = theirs[1:] if own.shape != theirs.shape else theirs
            assert torch.allclose(own.double(), theirs.double(), atol=1e-9), name

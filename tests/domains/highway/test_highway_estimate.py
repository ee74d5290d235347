"""States estimated from observations: what is exact, what is near, and what cannot be known."""

import pytest
import torch
from highway_states import state_of

from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.highway import Highway
from mirror_ppl.domains.highway.estimate import AWAY, HARD, cars_in
from mirror_ppl.domains.highway.road import LENGTH
from mirror_ppl.domains.highway.speech import DIRECTIONS, NOTHING

WORLD = Highway()


def test_the_ego_is_exact():
    controls = torch.tensor([0.25, -0.5], dtype=torch.float64)
    state = state_of((3.0, 7.5, 0.1, 9.0), controls=controls)
    found = WORLD.state_behind(WORLD.observe(state))
    for name in ("y", "heading", "speed"):
        torch.testing.assert_close(getattr(found, name)[0], getattr(state, name)[0])
    assert found.x[0] == 0 and torch.equal(found.controls, controls)
    assert not found.over and (found.x[1:].abs() >= AWAY).all()


@pytest.mark.parametrize(
    ("direction", "car"),
    [
        ("front", (30.0, 4.0, 0.0, 6.0)),
        ("front-right", (20.0, 8.0, 0.0, 12.0)),
        ("rear-right", (-25.0, 8.0, 0.0, 14.0)),
        ("rear", (-18.0, 4.0, 0.0, 15.0)),
        ("rear-left", (-30.0, 0.0, 0.0, 9.0)),
        ("front-left", (40.0, 0.0, 0.0, 3.0)),
    ],
)
def test_a_car_is_where_it_is_in_each_direction(direction, car):
    cars = cars_in(WORLD.observe(state_of(cars=[car])))
    place = DIRECTIONS.index(direction)
    assert cars.there.nonzero().flatten().tolist() == [place]
    x, y, _, speed = car
    # The nearest point is on the near end, up to half the width of the car from its middle.
    assert cars.x[place].item() == pytest.approx(x, abs=0.5)
    assert cars.y[place].item() == y and cars.speed[place].item() == pytest.approx(speed)
    assert not cars.brakes.any()


@pytest.mark.parametrize("lane", [0.0, 8.0])
@pytest.mark.parametrize("x", [-6.0, -4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0, 6.0])
def test_a_car_abreast_is_one_car(lane, x):
    """In the direction in which the sentences have it; its ends are seen to a sector's width."""
    now = WORLD.observe(state_of(cars=[(x, lane, 0.0, 9.0)]))
    cars = cars_in(now)
    spoken = (now["verbal"][:, 0] < NOTHING).nonzero().flatten().tolist()
    assert cars.there.nonzero().flatten().tolist() == spoken and len(spoken) == 1
    assert cars.x[spoken[0]].item() == pytest.approx(x, abs=0.6)


def test_cars_of_one_speed_are_two_cars():
    cars = cars_in(WORLD.observe(state_of(cars=[(9.0, 8.0, 0.0, 9.0), (-9.0, 8.0, 0.0, 9.0)])))
    assert cars.there.sum() == 2


def test_the_nearest_of_a_direction_hides_the_others():
    state = state_of(cars=[(45.0, 4.0, 0.0, 6.0), (25.0, 4.0, 0.0, 9.0)])
    found = WORLD.state_behind(WORLD.observe(state))
    assert (found.x.abs() < AWAY).sum() == 2
    assert found.x[1].item() == pytest.approx(25.0, abs=0.1)


def test_a_car_that_moves_sideways_keeps_doing_so():
    state = state_of(cars=[(15.0, 2.0, 0.2, 9.0)])  # from the left lane to the ego's
    found = WORLD.state_behind(WORLD.observe(state))
    number = int((found.x.abs()[1:] < AWAY).nonzero()[0]) + 1
    assert found.target_lane[number] == 1 and found.heading[number].item() == pytest.approx(
        0.2, abs=0.01
    )


def test_who_is_said_to_brake_slows_down():
    slows = torch.zeros(9, dtype=torch.float64)
    slows[1] = -3.0
    state = state_of(cars=[(30.0, 4.0, 0.0, 9.0)], acceleration=slows)
    found = WORLD.state_behind(WORLD.observe(state))
    assert found.acceleration[1] == -HARD and found.intended[1] < 2.0
    assert found.intended[0] == found.cruise[0]


def test_an_accident_is_an_accident():
    state = state_of(cars=[(LENGTH, 4.0, 0.0, 9.0)], crashed=torch.tensor(True))
    for over in (state, state_of((0.0, 14.0, 0.0, 9.0))):
        assert WORLD.over(WORLD.state_behind(WORLD.observe(over)))


def test_estimates_of_a_batch_are_those_of_each(generator):
    states = WORLD.initial(6, generator)
    grid = map_state(lambda part: part.reshape(2, 3, *part.shape[1:]), states)
    found = WORLD.state_behind(WORLD.observe(grid))
    one = WORLD.state_behind(WORLD.observe(map_state(lambda part: part[4], states)))
    for name, part in vars(one).items():
        assert torch.equal(getattr(found, name)[1, 1], part), name


def test_what_comes_next_is_not_determined_by_what_is_seen(generator):
    now = WORLD.observe(WORLD.initial(2, generator))
    following = WORLD.next_observation(now, torch.zeros(2, dtype=torch.long))
    assert all(part.isnan().all() for part in following.values())

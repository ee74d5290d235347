"""Every term of the reward, at states and actions where its value is worked out by hand."""

from dataclasses import replace

import pytest
import torch
from highway_states import state_of

from mirror_ppl.domains.highway.lidar import AHEAD, BACK, RANGE, scan
from mirror_ppl.domains.highway.reward import TERMS, proximities, rewards, speed_reward
from mirror_ppl.domains.highway.road import LIMIT
from mirror_ppl.domains.highway.world import DirectHighway

STILL = torch.zeros(2, dtype=torch.float64)


def terms(following, before=None, action=STILL):
    before = state_of() if before is None else before
    return {name: term.item() for name, term in rewards(before, action, following).items()}


def only(found, **expected):
    """Check the named terms, and that all others but the speed's are 0."""
    for name in TERMS:
        if name in expected:
            assert found[name] == pytest.approx(expected[name]), name
        elif name != "speed":
            assert found[name] == 0, name


def test_names_and_order():
    assert tuple(rewards(state_of(), STILL, state_of())) == TERMS == DirectHighway.reward_terms


def test_equation_7():
    kmh = torch.tensor([0.0, 20.0, 40.0, 40.5, 42.0, 60.0], dtype=torch.float64)
    expected = [0.0, 0.5, 1.0, -0.5, -2.0, -20.0]
    speed = kmh / 3.6
    speed[2] = LIMIT  # exactly
    assert speed_reward(speed).tolist() == pytest.approx(expected)
    before, after = state_of((0.0, 4.0, 0.0, 2.0)), state_of((0.0, 4.0, 0.0, 8.0))
    assert terms(after, before)["speed"] == pytest.approx(8 / LIMIT)  # of where a decision leads


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        ((0.0, -1.0), {"brake": -1.0}),
        ((0.0, -0.5), {"brake": -0.25}),
        ((0.0, 1.0), {}),
        ((0.5, 0.0), {"steer": -0.25}),
        ((-1.0, -1.0), {"steer": -1.0, "brake": -1.0}),
        ((-9.0, -9.0), {"steer": -1.0, "brake": -1.0}),
    ],
)
def test_braking_and_steering(action, expected):
    only(terms(state_of(), action=torch.tensor(action, dtype=torch.float64)), **expected)


def test_lane_change_and_centre():
    before, after = state_of((0.0, 5.9, 0.0, 10.0)), state_of((0.0, 6.1, 0.0, 10.0))
    only(terms(after, before), lane_change=-1.0, lane_centre=-0.95)
    only(terms(before, after), lane_change=-1.0, lane_centre=-0.95)
    only(terms(before, before), lane_centre=-0.95)
    only(terms(state_of((0.0, 3.5, 0.0, 10.0))), lane_centre=-0.25)


@pytest.mark.parametrize(
    ("car", "expected"),
    [
        ((22.4, 4.0, 0.0, 10.0), {"front_proximity": -2.0}),
        ((22.6, 4.0, 0.0, 10.0), {}),
        ((-22.4, 4.0, 0.0, 10.0), {"back_proximity": -2.0}),
        ((-22.6, 4.0, 0.0, 10.0), {}),
        # In the next lane neither of the two sectors sees a car within 20 m.
        ((20.0, 8.0, 0.0, 10.0), {}),
        ((-20.0, 0.0, 0.0, 10.0), {}),
        ((0.0, 8.0, 0.0, 10.0), {}),
        # A side at 1.5 m, and at 1.7 m.
        ((0.0, 6.5, 0.0, 10.0), {"near": -4.0}),
        ((0.0, 6.7, 0.0, 10.0), {}),
    ],
)
def test_proximity(car, expected):
    only(terms(state_of(cars=[car])), **expected)


def test_both_proximities_add_up():
    cars = [(15.0, 4.0, 0.0, 10.0), (-15.0, 4.0, 0.0, 10.0)]
    only(terms(state_of(cars=cars)), front_proximity=-2.0, back_proximity=-2.0)


def test_shoulder_and_the_end_of_the_road():
    edge = 10.0  # the line on the right
    only(
        terms(state_of((0.0, edge - 1.1, 0.0, 10.0)), state_of((0.0, 8.0, 0.0, 10.0))),
        lane_centre=-0.45,
    )
    for y in (edge - 0.9, -2.0 + 0.9):
        before = state_of((0.0, 8.0 if y > 0 else 0.0, 0.0, 10.0))
        centre = -abs(y - before.y[0].item()) / 2
        only(terms(state_of((0.0, y, 0.0, 10.0)), before), shoulder=-4.0, lane_centre=centre)
    assert not state_of((0.0, 11.9, 0.0, 10.0)).over
    for y in (12.1, -4.1):
        gone = state_of((0.0, y, 0.0, 10.0))
        assert gone.over
        assert terms(gone)["accident"] == -100.0


def test_an_accident_costs_once_and_then_nothing_is_won_or_lost():
    crashed = state_of(cars=[(4.0, 4.0, 0.0, 0.0)], crashed=torch.tensor(True))
    for ended in (crashed, state_of((0.0, 12.5, 0.0, 10.0))):
        assert terms(ended)["accident"] == -100.0
        assert set(terms(ended, ended, torch.ones(2)).values()) == {0.0}


def test_proximities_are_the_lidar_s(generator):
    """The reward looks at two sectors and at boxes; the lidar at all sectors. They agree."""
    world = DirectHighway()
    state = world.initial(300, generator)
    for _ in range(15):
        push = torch.rand(300, 2, generator=generator) * 2 - 1
        state = world.transition(state, push * torch.tensor([0.2, 1.0]))
    distance = scan(state)[..., 0]
    ahead, back, around = (each.clamp(max=RANGE) for each in proximities(state))
    for found, expected in ((ahead, AHEAD), (back, BACK)):
        assert torch.allclose(found, distance[..., expected], atol=0.016)
    assert torch.allclose(around, distance.amin(-1), atol=0.016)
    assert (around < 10).any() and (ahead < 20).any() and (back < 40).any()


def test_rewards_are_of_any_batch():
    one = replace(state_of(cars=[(20.0, 4.0, 0.0, 5.0)]))
    many = type(one)(**{k: v.expand(2, 3, *v.shape) for k, v in vars(one).items()})
    for name, term in rewards(many, STILL.expand(2, 3, 2), many).items():
        assert term.shape == (2, 3)
        assert (term == rewards(one, STILL, one)[name]).all()

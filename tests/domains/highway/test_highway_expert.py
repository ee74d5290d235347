"""The expert in situations whose best response is plain, and over some seconds of driving."""

from dataclasses import replace

import pytest
import torch
from highway_states import state_of

from mirror_ppl.domains.base import map_state, total_reward
from mirror_ppl.domains.highway import DirectHighway, expert
from mirror_ppl.domains.highway.road import LIMIT

WORLD = DirectHighway()
CRAWLS = (28.0, 4.0, 0.0, 1.5)


def steering_and_acceleration(*cars, ego=(0.0, 4.0, 0.0, 10.0), **fields):
    return expert.act(state_of(ego, cars, **fields)).tolist()


def test_on_a_free_road_it_drives_as_fast_as_allowed():
    steering, acceleration = steering_and_acceleration(ego=(0.0, 4.0, 0.0, 8.0))
    assert steering == 0 and acceleration > 0.5
    steering, acceleration = steering_and_acceleration(ego=(0.0, 4.0, 0.0, LIMIT + 2))
    assert steering == 0 and acceleration < -0.5


@pytest.mark.parametrize(("blocked", "sign"), [(0.0, 1), (8.0, -1)])
def test_it_passes_a_crawling_car_on_the_free_side(blocked, sign):
    beside = [(x, blocked, 0.0, 9.0) for x in (-16.0, -3.0, 10.0)]
    steering, _ = steering_and_acceleration(CRAWLS, *beside)
    assert steering * sign > 0.05


def test_it_brakes_where_no_lane_is_free():
    beside = [(x, y, 0.0, 9.0) for x in (-14.0, -2.0, 10.0) for y in (0.0, 8.0)]
    steering, acceleration = steering_and_acceleration(CRAWLS, *beside)
    assert steering == 0 and acceleration < -0.3


def test_it_makes_way_for_a_fast_car_from_behind():
    """It changes to a free lane at once; the gap ahead is too small to run away."""
    behind, ahead = (-18.0, 4.0, 0.0, 14.0), (30.0, 4.0, 0.0, 9.5)
    headway = torch.full((9,), 0.3, dtype=torch.float64)
    steering, _ = steering_and_acceleration(behind, ahead, headway=headway)
    assert abs(steering) > 0.05


def test_it_does_not_foresee_events():
    """A car ahead that will brake in a second counts once it does so."""
    never = state_of((0.0, 4.0, 0.0, 10.0), [(27.0, 4.0, 0.0, 10.0)])
    cue_at, cue_for, begun = (part.clone() for part in (never.cue_at, never.cue_for, never.begun))
    cue_at[1], cue_for[1] = 20, 100
    soon = replace(never, cue_at=cue_at, cue_for=cue_for)
    assert torch.equal(expert.act(soon), expert.act(never))
    begun[1] = 0
    assert not torch.equal(expert.act(replace(soon, begun=begun)), expert.act(never))


def test_it_gets_around_a_crawling_car_that_hits_whoever_coasts():
    """Two seconds of four rounds with a short horizon; whoever does nothing has an accident."""
    generator = torch.Generator().manual_seed(0)
    index = torch.full((4,), WORLD.scenarios.index("car ahead crawls"))
    start = WORLD.initial(4, generator, index)
    x = start.x.clone()
    x[:, 1] = 18.0
    options = expert.ExpertOptions(horizon=6)
    now = idle = replace(start, x=x)
    ahead = 0.0
    for _ in range(11):
        gained = []
        for state, action in ((now, expert.act(now, options)), (idle, torch.zeros(4, 2))):
            following = WORLD.transition(state, action)
            reward = total_reward(WORLD.rewards(state, action, following)).mean().item()
            gained.append((following, reward))
        (now, own), (idle, other) = gained
        ahead += own - other
    assert idle.over.all() and not now.over.any()
    assert ahead > 80  # of 100 that an accident costs


def test_any_batch():
    one = state_of(cars=[CRAWLS])
    grid = map_state(lambda part: part.expand(2, 3, *part.shape), one)
    found = expert.act(grid, expert.ExpertOptions(horizon=3))
    assert found.shape == (2, 3, 2)
    assert torch.equal(found[1, 2], expert.act(one, expert.ExpertOptions(horizon=3)))


def test_an_expert_that_looks_nowhere_is_refused():
    with pytest.raises(ValueError, match="horizon of at least 1"):
        expert.ExpertOptions(horizon=0)

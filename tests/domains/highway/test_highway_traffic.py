"""Physics of traffic, by mechanics worked out by hand; parity with highway-env has its own file."""

import math
from dataclasses import replace

import pytest
import torch
from highway_states import state_of

from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.highway import scenarios, traffic
from mirror_ppl.domains.highway.road import (
    LANE_WIDTH,
    LANES,
    LENGTH,
    LIMIT,
    ROUND_TICKS,
    TICK,
    TICKS,
    centre_of,
)
from mirror_ppl.domains.highway.state import NEVER
from mirror_ppl.domains.highway.world import DirectHighway

WORLD = DirectHighway()
STEP = TICK * TICKS


def batched(state):
    return map_state(lambda part: part[None], state)


def play(state, action=(0.0, 0.0), steps=1):
    action = torch.tensor(action, dtype=state.x.dtype)
    for _ in range(steps):
        state = WORLD.transition(state, action.expand(*state.tick.shape, 2))
    return state


def rounds(name, batch, generator):
    index = torch.full((batch,), WORLD.scenarios.index(name))
    return WORLD.initial(batch, generator, index)


# --- the ego ------------------------------------------------------------------------------------


def test_speed_and_way_at_constant_acceleration():
    """Each tick first moves and then accelerates."""
    end = play(state_of((0.0, 4.0, 0.0, 2.0)), (0.0, 0.4), steps=5)
    ticks = 5 * TICKS
    assert end.speed[0].item() == pytest.approx(2 + 2.0 * ticks * TICK)
    way = sum((2 + 2.0 * k * TICK) * TICK for k in range(ticks))
    assert end.x[0].item() == pytest.approx(way)
    assert (end.y[0].item(), end.heading[0].item()) == (4.0, 0.0)
    assert end.tick.item() == ticks


def test_turning_circle():
    """Full steering at 10 m/s: the heading turns by 2 v sin(beta) / LENGTH, to the right."""
    slip = math.atan(math.tan(0.2) / 2)
    end = play(state_of((0.0, 0.0, 0.0, 10.0)), (1.0, 0.0), steps=3)
    assert end.heading[0].item() == pytest.approx(10 * math.sin(slip) / (LENGTH / 2) * 3 * STEP)
    assert end.y[0] > 0
    left = play(state_of((0.0, 8.0, 0.0, 10.0)), (-1.0, 0.0), steps=3)
    assert left.y[0].item() - 8 == pytest.approx(-end.y[0].item())


def test_actions_are_cut_to_their_limits_and_kept_as_controls():
    end = play(state_of(), (7.0, -3.0))
    assert end.controls.tolist() == [1.0, -1.0]
    assert torch.equal(end.y, play(state_of(), (1.0, -1.0)).y)


def test_speed_has_limits():
    fast = play(state_of((0.0, 4.0, 0.0, 16.0)), (0.0, 1.0), steps=20)
    assert 60 / 3.6 <= fast.speed[0].item() < 60 / 3.6 + 5 * TICK
    slow = play(state_of((0.0, 4.0, 0.0, 1.0)), (0.0, -1.0), steps=20)
    assert -5 * TICK < slow.speed[0].item() <= 0


def test_a_collision_stops_the_round():
    start = state_of((0.0, 4.0, 0.0, 12.0), [(12.0, 4.0, 0.0, 0.1)])
    end = play(start, steps=4)
    # Bumpers are 7 m apart, closing at nearly 12 m/s.
    assert end.crashed and 8 <= end.tick < 16
    assert end.x[1] - end.x[0] == pytest.approx(LENGTH, abs=12 * TICK)
    after = play(end, (1.0, 1.0), steps=3)
    for name in ("x", "y", "speed", "tick"):
        assert torch.equal(getattr(after, name), getattr(end, name))
    assert WORLD.over(end)


def test_who_leaves_the_shoulder_does_not_come_back():
    """Steering back would bring it onto the road again."""
    gone = state_of((0.0, 12.1, -0.3, 10.0))
    assert WORLD.over(gone) and not WORLD.over(state_of((0.0, 11.9, -0.3, 10.0)))
    after = play(gone, (-1.0, 1.0), steps=10)
    for name, part in vars(gone).items():
        assert torch.equal(part, getattr(after, name)), name


# --- others -------------------------------------------------------------------------------------


def test_idm_by_hand():
    def found(*numbers):
        return traffic.idm(*(torch.tensor(n, dtype=torch.float64) for n in numbers)).item()

    # Free road: 3 m/s2 from rest, none at the intended speed.
    assert found(0.0, 10.0, 1.5, math.inf, 0.0) == pytest.approx(3.0)
    assert found(10.0, 10.0, 1.5, math.inf, 0.0) == pytest.approx(0.0)
    assert found(5.0, 10.0, 1.5, math.inf, 0.0) == pytest.approx(3 * (1 - 1 / 16))
    # Standing at the jam distance is an equilibrium.
    assert found(0.0, 10.0, 1.5, 10.0, 0.0) == pytest.approx(0.0)
    # Wanted: 10 + 8 * 1.5 + 8 * 2 / (2 sqrt 15) m.
    wanted = 22 + 16 / (2 * math.sqrt(15))
    expected = 3 * (1 - 0.8**4) - 3 * (wanted / 40) ** 2
    assert found(8.0, 10.0, 1.5, 40.0, 2.0) == pytest.approx(expected)


def test_a_car_follows_at_the_distance_of_the_idm():
    """Behind a car at 8 m/s: speeds agree, and the gap is that of no acceleration."""
    cars = [(35.0, 0.0, 0.0, 8.0), (0.0, 0.0, 0.0, 11.0)]
    end = play(state_of((0.0, 8.0, 0.0, 8.0), cars), steps=100)
    assert end.speed[2].item() == pytest.approx(8.0, abs=0.05)
    gap = (10 + 8 * 1.5) / math.sqrt(1 - (8 / 11) ** 4)
    assert (end.x[1] - end.x[2]).item() == pytest.approx(gap, abs=0.5)


@pytest.mark.parametrize("behind", [None, 6.0])
def test_mobil_changes_to_a_free_lane_unless_it_cuts_somebody_off(behind):
    cars = [(20.0, 0.0, 0.0, 5.0), (0.0, 0.0, 0.0, 9.0)]
    if behind is not None:
        cars.append((-behind, 4.0, 0.0, 12.0))
    start = state_of((0.0, 8.0, 0.0, 9.0), cars)
    changes = torch.zeros(len(start.x), dtype=torch.bool)
    changes[2] = True
    cruise = start.cruise.clone()
    cruise[2] = 11.0
    start = replace(start, changes=changes, cruise=cruise)
    soon = play(start, steps=6)
    assert soon.target_lane[2] == (1 if behind is None else 0)
    if behind is None:
        end = play(start, steps=25)
        assert end.y[2].item() == pytest.approx(LANE_WIDTH, abs=0.3)


def test_a_car_gives_up_a_change_when_somebody_ahead_moves_there_too():
    """From both outer lanes to the middle one; the one behind stays where it is."""
    cars = [(10.0, 0.0, 0.0, 10.0), (0.0, 8.0, 0.0, 10.0)]
    start = state_of((-60.0, 4.0, 0.0, 10.0), cars)
    target, changes = start.target_lane.clone(), torch.zeros_like(start.changes)
    target[1:3], changes[1:3] = 1, True
    end = play(replace(start, target_lane=target, changes=changes))
    assert end.target_lane[1:3].tolist() == [1, 2]


def test_neighbours_are_the_next_cars_of_a_lane():
    cars = [
        (10.0, 4.0, 0.0, 9.0),
        (20.0, 4.0, 0.0, 9.0),
        (-5.0, 4.0, 0.0, 9.0),
        (3.0, 6.9, 0.0, 9.0),
    ]
    flow = traffic.Flow.of(batched(state_of(cars=cars)))
    who = torch.tensor([[0, 0, 0, 2]])
    lane = torch.tensor([[0, 1, 2, 1]])
    ahead, behind = traffic.neighbours(flow, who, lane)
    # The last car straddles the line: within 3 m of the middles of two lanes.
    assert ahead[0, 1:3].tolist() == [4, 4]
    assert behind[0].tolist() == [-1, 3, -1, 1]
    assert ahead[0, 0] == -1 and ahead[0, 3] >= 5


def test_an_event_begins_when_its_time_and_place_have_come():
    cars = [(2.0, 0.0, 0.0, 12.0)]
    start = state_of((0.0, 4.0, 0.0, 10.0), cars)

    def with_cue(**cue):
        parts = {}
        for name, value in cue.items():
            parts[name] = getattr(start, name).clone()
            parts[name][1] = value
        return replace(start, **parts)

    cued = with_cue(cue_at=10, cue_gap=6.0, cue_lane=1, cue_speed=6.0, cue_for=20)
    # 2 m/s faster, it is 6 m ahead after 2 s: tick 40.
    before, after = play(cued, steps=10), play(cued, steps=11)
    assert before.begun[1] == NEVER and before.target_lane[1] == 0
    assert after.begun[1] == 40 and after.target_lane[1] == 1
    assert after.intended[1] == 6.0 and after.speed[1] < 12.0
    slows = with_cue(cue_at=10, cue_gap=6.0, cue_lane=0, cue_speed=6.0, cue_for=20)
    # After 20 ticks it intends what it did before.
    assert [play(slows, steps=steps).intended[1] for steps in (14, 15)] == [6.0, 12.0]
    assert play(with_cue(cue_at=NEVER, cue_gap=-100.0, cue_lane=1), steps=20).begun[1] == NEVER


# --- rounds -------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_round(seed):
    def end(number):
        generator = torch.Generator().manual_seed(number)
        state = WORLD.initial(20, generator)
        for _ in range(10):
            push = torch.rand(20, 2, generator=generator) * 2 - 1
            state = WORLD.transition(state, push * torch.tensor([0.1, 1.0]))
        return state

    first, again, other = end(seed), end(seed), end(seed + 1)
    for name, part in vars(first).items():
        assert torch.equal(part, getattr(again, name)), name
    assert not torch.equal(first.x, other.x)


def test_rounds_of_a_batch_do_not_touch_each_other(generator):
    """Alone, in a batch, and in a batch of two dimensions; and nothing that is given changes."""
    start = WORLD.initial(12, generator)
    kept = map_state(torch.clone, start)
    action = torch.rand(12, 2, generator=generator) * 0.2
    many = start
    grid = map_state(lambda part: part.reshape(3, 4, *part.shape[1:]), start)
    alone = map_state(lambda part: part[7], start)
    for _ in range(15):
        many = WORLD.transition(many, action)
        grid = WORLD.transition(grid, action.reshape(3, 4, 2))
        alone = WORLD.transition(alone, action[7])
    for name, part in vars(many).items():
        assert torch.allclose(part, getattr(grid, name).reshape(part.shape), atol=1e-4), name
        assert torch.allclose(part[7], getattr(alone, name), atol=1e-4), name
        assert torch.equal(getattr(start, name), getattr(kept, name)), name


@pytest.mark.parametrize("name", scenarios.NAMES)
def test_cars_start_apart_on_their_lanes(name, generator):
    state = rounds(name, 200, generator)
    assert not traffic.tick(state).crashed.any()
    lanes = set(scenarios.SCENARIOS[name].lanes)
    assert set(state.lane[:, 0].tolist()) == lanes
    same = state.lane[:, :, None] == state.lane[:, None]
    gap = (state.x[:, :, None] - state.x[:, None]).abs()
    apart = gap[same & ~torch.eye(gap.shape[-1], dtype=torch.bool)]
    assert apart.min() > 2 * LENGTH - 1e-3


@pytest.fixture(scope="module")
def coasting():
    """States ``[T + 1, scenarios, 25]`` of rounds in which the ego keeps its speed and lane."""
    many = len(WORLD.scenarios)
    index = torch.arange(many).repeat_interleave(25)
    states = [WORLD.initial(len(index), torch.Generator().manual_seed(0), index)]
    for _ in range(ROUND_TICKS // TICKS):
        states.append(play(states[-1]))
    return map_state(lambda *parts: torch.stack(parts).unflatten(1, (many, 25)), *states)


def of(coasting, name):
    """States ``[T + 1, 25]`` of one scenario."""
    return map_state(lambda part: part[:, WORLD.scenarios.index(name)], coasting)


def share(condition):
    return condition.float().mean().item()


def test_the_car_ahead_brakes(coasting):
    state = of(coasting, "car ahead brakes")
    assert share(state.crashed[-1]) > 0.3  # whoever coasts
    least = state.speed[..., 1].amin(0)
    assert (least[~state.crashed[-1]] < 3.5).all()


@pytest.mark.parametrize(("side", "car"), [("left", 5), ("right", 3)])
def test_a_car_cuts_in(side, car, coasting):
    """It is in the ego's lane soon after, if it does not hit the ego before."""
    state = of(coasting, f"car on the {side} cuts in")
    began = state.begun[..., car] < NEVER
    arrived = began & (state.lane[..., car] == state.lane[..., 0])
    assert (began[0] == 0).all() and share(began.any(0)) > 0.9
    assert share(arrived.any(0) | state.crashed[-1]) > 0.9


@pytest.mark.parametrize("name", ["fast car behind", "braking ahead, fast car behind"])
def test_a_fast_car_comes_close_from_behind(name, coasting):
    state = of(coasting, name)
    gap = (state.x[..., 0] - state.x[..., 4]).amin(0)
    assert share((gap < 20) | state.crashed[-1]) > 0.9


@pytest.mark.parametrize(("side", "car"), [("left", 5), ("right", 3)])
def test_a_fast_car_passes_on_the_side_to_which_the_ego_would_escape(side, car, coasting):
    """Behind at first and ahead before the ego reaches the slow car in front of it."""
    state = of(coasting, f"fast car on the {side}, slow one ahead")
    ahead = state.x[..., car] - state.x[..., 0]
    assert (ahead[0] < -25).all() and share(ahead.amax(0) > 0) > 0.5
    assert (state.lane[0, :, car] - state.lane[0, :, 0] == (-1 if side == "left" else 1)).all()
    assert share(state.crashed[-1]) > 0.9


def test_who_coasts_behind_a_crawling_car_hits_it(coasting):
    assert share(of(coasting, "car ahead crawls").crashed[-1]) > 0.9


def test_calm_traffic_does_nothing_unusual(generator):
    state = rounds("calm traffic", 40, generator)
    assert (state.cue_at == NEVER).all() and (state.headway == scenarios.HEADWAY).all()
    assert (state.cruise[:, 0] == torch.tensor(LIMIT)).all()


def test_other_cars_stay_on_the_road(coasting):
    """In the numbers of few digits in which rounds are played, unlike those of parity."""
    y, heading = coasting.y[..., 1:], coasting.heading[..., 1:]
    assert y.dtype == torch.float32
    assert (coasting.target_lane[-1] != coasting.target_lane[0]).any()
    edges = centre_of(torch.tensor([0, LANES - 1]))
    assert edges[0] - LANE_WIDTH / 2 < y.min() and y.max() < edges[1] + LANE_WIDTH / 2
    assert heading.abs().max() < math.pi / 4


@pytest.mark.parametrize("speed", [0.5, 2.0, 5.0, 8.0, 15.0])
def test_cars_steer_alike_in_few_and_in_many_digits(speed):
    """Slow ones turn the wheels to their limit, to the side of the lane that they move to."""
    across = torch.tensor([-8.0, -4.0, -1.0, 1.0, 4.0, 8.0])
    cars = [(20.0 * place, 4.0, 0.0, speed) for place in range(1, 1 + len(across))]
    found = []
    for dtype in (torch.float32, torch.float64):
        state = state_of(cars=cars, dtype=dtype)
        goal = state.y.clone()
        goal[1 : 1 + len(across)] += across.to(dtype)
        found.append(traffic.steer_to(traffic.Flow.of(state), goal)[1 : 1 + len(across)])
    torch.testing.assert_close(found[0].double(), found[1], atol=1e-5, rtol=0)
    assert (found[0].sign() == across.sign()).all()
    assert found[0].abs().max() == pytest.approx(traffic.WHEEL_LIMIT) or speed > 10

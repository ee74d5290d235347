"""Driving: moves, rewards and starts, against numbers from the supplement (A, E, Table I)."""

import itertools

import numpy as np
import pytest
import torch
from example_driving import STAY, SWITCH, rollout, same, state
from scipy.stats import chisquare

from mirror_ppl.domains import DOMAINS, Modality, get_domain
from mirror_ppl.domains.base import total_reward
from mirror_ppl.domains.driving import CARS, SCENARIO_SPEEDS, Driving, DrivingState
from mirror_ppl.errors import UnknownNameError

TERMS = ("proximity", "collision", "off_road", "lane_change")


@pytest.fixture
def domain():
    return Driving()


# The left lane squeezes: front-left and rear-left close in, the cars of the right lane drive away.
# Action, then what must follow: lane, positions, proximity, collision, lane change.
ROUND = [
    (STAY, 0, (2, 3, -3, -10), -2, 0, 0),
    (STAY, 0, (1, 4, -2, -11), -4, 0, 0),
    (STAY, 0, (0, 5, -1, -12), -4, -5, 0),
    (SWITCH, 1, (-1, 6, 0, -13), 0, 0, -1),
    (SWITCH, 0, (-2, 7, 1, -14), -4, 0, -1),
    (STAY, 0, (-3, 8, 2, -15), -2, 0, 0),
    (STAY, 0, (-4, 9, 3, -16), 0, 0, 0),
]


def test_a_round_worked_out_by_hand(domain):
    now = state(0, (3, 2, -4, -9))
    for action, lane, position, proximity, collision, lane_change in ROUND:
        after = domain.transition(now, torch.tensor(action))
        assert same(after, state(lane, position))
        terms = domain.rewards(now, torch.tensor(action), after)
        expected = dict(zip(TERMS, (proximity, collision, 0, lane_change), strict=True))
        assert {name: term.item() for name, term in terms.items()} == expected
        assert total_reward(terms).item() == proximity + collision + lane_change
        now = after


def test_rewards_look_at_the_state_that_the_action_leads_to(domain):
    # A car abreast in the other lane: harmless until the ego switches into it.
    start = state(1, (1, 11, -11, -11))
    for action, expected in ((STAY, (0, 0, 0, 0)), (SWITCH, (-2, -5, 0, -1))):
        after = domain.transition(start, torch.tensor(action))
        terms = domain.rewards(start, torch.tensor(action), after)
        assert tuple(terms[name].item() for name in TERMS) == expected


@pytest.mark.parametrize("gap", range(-4, 5))
def test_a_car_of_the_own_lane_is_too_near_at_up_to_two_cells(domain, gap):
    after = state(1, (gap, gap, 11, 11))
    terms = domain.rewards(after, torch.tensor(STAY), after)
    assert terms["proximity"].item() == (-2 if abs(gap) <= 2 else 0)
    assert terms["collision"].item() == (-5 if gap == 0 else 0)


@pytest.mark.parametrize(("lane", "penalty"), [(-1, -5), (0, 0), (1, 0), (2, -5)])
def test_off_road_is_a_lane_that_does_not_exist(domain, lane, penalty):
    after = state(lane, (11, 11, -11, -11))
    assert domain.rewards(after, torch.tensor(STAY), after)["off_road"].item() == penalty


def test_switching_twice_returns_to_the_lane_and_never_leaves_the_road(domain, generator):
    start = domain.initial(64, generator)
    actions = torch.randint(2, (64, domain.horizon), generator=generator)
    states, _ = rollout(domain, start, actions)
    switches = torch.nn.functional.pad(actions.cumsum(-1), (1, 0))
    expected = (start.lane[:, None] + switches) % 2
    assert torch.equal(torch.stack([s.lane for s in states], -1), expected)


def test_cars_keep_their_speed_and_take_no_notice_of_the_ego(domain, generator):
    start = domain.initial(64, generator)
    actions = torch.randint(2, (64, domain.horizon), generator=generator)
    states, _ = rollout(domain, start, actions)
    for step, after in enumerate(states):
        assert torch.equal(after.speed, start.speed)
        assert torch.equal(after.position, start.position + step * start.speed)


def test_when_a_round_ends_every_car_has_left_the_neighbourhood(domain, generator):
    states, _ = rollout(domain, domain.initial(2000, generator), torch.zeros(2000, 15).long())
    assert states[-1].position.abs().min() > 2


def test_scenarios_say_which_cars_close_in(domain):
    closing = {
        name: {
            car for car, v in zip(CARS, speed, strict=True) if v == (-1 if "front" in car else 1)
        }
        for name, speed in SCENARIO_SPEEDS.items()
    }
    assert closing == {
        "front-left slows": {"front-left"},
        "front-right slows": {"front-right"},
        "both front cars slow": {"front-left", "front-right"},
        "left lane squeezes": {"front-left", "rear-left"},
        "right lane squeezes": {"front-right", "rear-right"},
        "front-left slows, rear-right speeds up": {"front-left", "rear-right"},
        "front-right slows, rear-left speeds up": {"front-right", "rear-left"},
        "all four close in": set(CARS),
    }
    assert domain.scenarios == tuple(closing)
    assert {abs(v) for speed in SCENARIO_SPEEDS.values() for v in speed} == {1}
    assert len(set(SCENARIO_SPEEDS.values())) == 8


def test_starts_are_uniform(domain, generator):
    start = domain.initial(22_000, generator)
    rows = (start.speed[:, None] == torch.tensor(list(SCENARIO_SPEEDS.values()))).all(-1)
    assert torch.equal(rows.sum(-1), torch.ones(22_000).long())
    sides = torch.tensor([1, 1, -1, -1])
    counts = [torch.bincount(start.lane), rows.sum(0)]
    for car in range(4):
        distance = start.position[:, car] * sides[car]
        assert (distance.min().item(), distance.max().item()) == (1, 11)
        counts.append(torch.bincount(distance)[1:])
    for count in counts:  # six tests at 1e-6 each: one false alarm in 170,000 seeds
        assert chisquare(count.numpy()).pvalue > 1e-6


def test_a_given_scenario_is_used(domain, generator):
    indices = torch.arange(8).repeat(3)
    start = domain.initial(24, generator, indices)
    assert start.speed.tolist() == [list(v) for v in SCENARIO_SPEEDS.values()] * 3


def test_one_seed_gives_one_rollout_and_global_randomness_is_left_alone(domain, seed):
    before = torch.get_rng_state()

    def play(number):
        generator = torch.Generator().manual_seed(number)
        start = domain.initial(32, generator)
        actions = torch.randint(2, (32, domain.horizon), generator=generator)
        return rollout(domain, start, actions)

    (states, terms), (again, terms_again) = play(seed), play(seed)
    assert all(map(same, states, again)) and all(map(same, terms, terms_again))
    assert not same(states[0], play(seed + 1)[0][0])
    assert torch.equal(torch.get_rng_state(), before)


def test_there_are_1348096_reachable_states(domain):
    ahead = torch.arange(1, 12)
    position = torch.cartesian_prod(ahead, ahead, -ahead, -ahead)
    reached = 0
    # Scenarios and lanes share no state; both lanes can be had at any step, whatever the cars do.
    for speed, lane in itertools.product(SCENARIO_SPEEDS.values(), (0, 1)):
        now = DrivingState(
            torch.full((len(position),), lane), position, torch.tensor(speed).expand_as(position)
        )
        codes = []
        for _ in range(domain.horizon + 1):
            codes.append(((now.position + 30) * 64 ** torch.arange(4)).sum(-1))
            now = domain.transition(now, torch.tensor(STAY))
        reached += len(torch.unique(torch.cat(codes)))
    # Each of the 15 steps moves the block of 11**4 positions along a diagonal.
    assert reached == 8 * 2 * (11**4 + 15 * (11**4 - 10**4)) == 1_348_096
    assert reached > 1e5


def test_reference_values_are_those_of_a_short_sum(domain):
    # Only rear-left, two cells behind and closing, meets this ego. Leaving at once costs a lane
    # change; staying costs a step at one cell, and the lane change one step later.
    start = state(0, (9, 9, -2, -9), speed=(1, 1, 1, -1))
    assert domain.reference_values(start, 1.0).tolist() == [-2 - 1, -1]
    assert domain.reference_values(start, 0.5).tolist() == [-2 - 0.5 * 1, -1]
    # In the other lane it never meets anybody, and switching only costs.
    aside = state(1, (9, 9, -2, -9), speed=(1, 1, 1, -1))
    assert domain.reference_values(aside, 1.0).tolist() == [0, -1 - 2 - 1]


def test_a_batch_is_its_rounds_one_by_one(domain, generator):
    start = domain.initial(24, generator)
    actions = torch.randint(2, (24, domain.horizon), generator=generator)

    def everything(begin, chosen):
        states, terms = rollout(domain, begin, chosen)
        last = states[-1]
        observed = domain.observe(last)
        direction, distance = domain.distance(observed)
        return {
            **vars(last),
            **{f"reward {k}": sum(t[k] for t in terms) for k in TERMS},
            **{f"observed {k}": v for k, v in observed.items()},
            **{f"symbols {k}": v for k, v in domain.symbols(observed).items()},
            **{f"fog {k}": v for k, v in domain.visibility("fog", observed).items()},
            **{f"allowed {k}": v for k, v in domain.communicable(observed).items()},
            "direction": direction,
            "distance": distance,
            "values": domain.reference_values(begin, 0.95),
        }

    together = everything(start, actions)
    for i in range(24):
        alone = everything(
            DrivingState(start.lane[i], start.position[i], start.speed[i]), actions[i]
        )
        assert same({k: v[i] for k, v in together.items()}, alone)


def test_leading_dimensions_are_free(domain, generator):
    flat = domain.initial(6, generator)
    block = DrivingState(*(x.reshape(2, 3, *x.shape[1:]) for x in vars(flat).values()))
    for name, value in domain.observe(flat).items():
        assert torch.equal(domain.observe(block)[name].reshape(value.shape), value)
    values = domain.reference_values(flat, 0.9)
    assert torch.equal(domain.reference_values(block, 0.9).reshape(6, 2), values)


def test_names_are_checked(domain):
    assert get_domain("driving") is DOMAINS["driving"]
    with pytest.raises(UnknownNameError, match='unknown domain "drivin".*driving'):
        get_domain("drivin")
    with pytest.raises(UnknownNameError, match='unknown setting "snow".*clear, fog'):
        domain.visibility("snow", domain.observe(state(0, (1, 1, -1, -1))))
    assert domain.reward_terms == TERMS
    with pytest.raises(ValueError, match="needs a unit and a scale"):
        Modality("visual", ("car",), ("distance",), ("cells", "lanes"), (1.0,), 0.0)


def test_what_a_person_does_not_perceive_is_pale():
    """A car counts as perceived by eye or by ear."""
    seen = {"visual": torch.tensor([True, False, False, False])}
    seen["verbal"] = torch.tensor([False, False, True, False])
    now = state(0, (3, 2, -4, -9))
    whole, part = Driving().render(now), Driving().render_seen(now, seen)
    changed = (whole != part).any(-1)
    expected = np.zeros_like(changed)
    for ahead in (2, -9):  # of the cars in lane 1
        left = (ahead + 12) * 16
        expected[19:29, left + 1 : left + 15] = True
    assert np.array_equal(changed, expected)
    assert {tuple(colour) for colour in part[changed].tolist()} == {(246, 221, 166)}

"""The driving domain against numbers worked out by hand from the supplement (A, E, Table I)."""

import itertools

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from mirror_ppl.domains import DOMAINS, Modality, get_domain
from mirror_ppl.domains.base import total_reward
from mirror_ppl.domains.driving import CAR_LANES, CARS, SCENARIO_SPEEDS, Driving, DrivingState
from mirror_ppl.errors import UnknownNameError

STAY, SWITCH = 0, 1
TERMS = ("proximity", "collision", "off_road", "lane_change")


@pytest.fixture
def domain():
    return Driving()


def state(lane, position, speed=(-1, 1, 1, -1)):
    return DrivingState(torch.tensor(lane), torch.tensor(position), torch.tensor(speed))


def same(first, second):
    """Whether two states, or two dictionaries of tensors, hold the same numbers."""
    first, second = (x if isinstance(x, dict) else vars(x) for x in (first, second))
    return first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)


def rollout(domain, start, actions):
    """States ``T + 1`` and reward terms ``T`` under actions ``[..., T]``."""
    states, terms = [start], []
    for action in actions.unbind(-1):
        states.append(domain.transition(states[-1], action))
        terms.append(domain.rewards(states[-2], action, states[-1]))
    return states, terms


# --- mechanics and rewards ----------------------------------------------------------------------

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


# --- start ----------------------------------------------------------------------------------------


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


# --- what can be seen and said ------------------------------------------------------------------


def test_observation_of_a_state_by_hand(domain):
    observed = domain.observe(state(1, (11, 12, -11, -17), speed=(-1, 1, 1, -1)))
    assert observed["ego"].tolist() == [1]
    visual = [[11, -1], [12, 0], [-11, -1], [-12, 0]]
    assert observed["visual"].tolist() == visual
    # Off the visible road, at 12 cells and beyond, there is no speed to speak of.
    speed = [-1, 0, 1, 0]
    assert observed["verbal"].tolist() == [[*v, s] for v, s in zip(visual, speed, strict=True)]


def test_saturated_observations_stay_the_same(domain):
    near, far = (domain.observe(state(0, (x, 1, -x, -1))) for x in (12, 99))
    assert same(near, far)


@pytest.mark.parametrize("lane", [0, 1])
@pytest.mark.parametrize("cells", range(-13, 14))
def test_fog_leaves_two_cells_ahead_in_both_lanes(domain, cells, lane):
    observed = domain.observe(state(lane, (cells,) * 4))
    fog, clear = (domain.visibility(setting, observed) for setting in ("fog", "clear"))
    assert fog["visual"].tolist() == [cells in (0, 1, 2)] * 4
    assert clear["visual"].all()
    assert not fog["verbal"].any() and not clear["verbal"].any()


@pytest.mark.parametrize("cells", range(-13, 14))
def test_cars_in_front_can_be_shown_and_all_on_the_road_spoken_of(domain, cells):
    allowed = domain.communicable(domain.observe(state(0, (cells,) * 4)))
    assert allowed["visual"].tolist() == [0 <= cells < 12] * 4
    assert allowed["verbal"].tolist() == [-12 < cells < 12] * 4


def test_costs_are_those_of_table_1(domain):
    visual, verbal = domain.modalities
    number = torch.arange(5)
    torch.testing.assert_close(visual.cost(number), torch.tensor([0, 0.01, 0.04, 0.09, 0.16]))
    torch.testing.assert_close(verbal.cost(number), torch.tensor([0, 0.03, 0.12, 0.27, 0.48]))


def test_directions_and_distances(domain):
    observed = domain.observe(state(0, (3, 0, -4, -20)))
    direction, distance = domain.distance(observed)
    names = [domain.directions[i] for i in direction.tolist()]
    assert names == ["front_own", "front_other", "back_own", "back_other"]
    assert distance.tolist() == [3, 0, 4, 12]
    direction, _ = domain.distance(domain.observe(state(1, (3, 0, -4, -20))))
    names = [domain.directions[i] for i in direction.tolist()]
    assert names == ["front_other", "front_own", "back_other", "back_own"]


def test_reach_bins_go_up_to_the_whole_road(domain):
    assert domain.reach_bins[0] == 0 and domain.reach_bins[-1] == 12
    assert list(domain.reach_bins) == sorted(set(domain.reach_bins))
    assert 2 in domain.reach_bins  # what fog leaves


def blind(expected):
    """What a person sees by themselves who sees nothing."""
    nothing = torch.zeros_like(expected["visual"][..., 0], dtype=torch.bool)
    return {"visual": nothing, "verbal": nothing}


def after_one_step(domain, now, **visible):
    """Knowledge of a person to whom these items of a state were communicated."""
    observed = domain.observe(now)
    return domain.learn(
        domain.nothing_known(*now.lane.shape), observed, blind(observed) | visible, blind
    )


def test_clear_is_about_cars_neither_seen_nor_communicated_yet(domain):
    seen = torch.tensor([[1, 0, 0, 0], [0, 0, 0, 0], [0, 1, 0, 0]]).bool()
    told = torch.tensor([[0, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]]).bool()
    observed = domain.observe(state(0, (5, 6, -7, -8)))
    knowledge, unknown = domain.nothing_known(), []
    for visual, verbal in zip(seen, told, strict=True):
        visible = {"visual": visual, "verbal": verbal}
        knowledge = domain.learn(knowledge, observed, visible, blind)
        items, _ = domain.assume(knowledge, observed)
        unknown.append(items["clear"]["visual"].int().tolist())
        assert not items["clear"]["verbal"].any()
    assert unknown == [[0, 1, 1, 1], [0, 1, 0, 1], [0, 0, 0, 1]]


def test_clear_is_the_same_lane_and_an_empty_road(domain):
    observed = domain.observe(state(1, (3, 0, -4, -20)))
    kept = {name: value.clone() for name, value in observed.items()}
    _, empty = domain.assume(domain.nothing_known(), observed)
    assert same(observed, kept)  # a copy, not the original
    gone = state(1, (99, 99, 99, 99))
    assert same(empty, domain.observe(gone))
    assert not any(mask.any() for mask in domain.communicable(empty).values())


def test_who_assumes_a_clear_road_supposes_it_for_a_whole_round(domain, generator):
    start = domain.initial(50, generator)
    spoken = torch.rand(50, 4, generator=generator) < 0.5
    clear = torch.rand(50, generator=generator) < 0.5
    knowledge = after_one_step(domain, start, verbal=spoken)
    assumes = {"clear": clear, "closing": ~clear}
    supposed = domain.supposed(start, knowledge, assumes)
    states, _ = rollout(domain, supposed, torch.zeros(50, 15).long())
    full, _ = rollout(domain, start, torch.zeros(50, 15).long())
    gone = ~spoken & clear[:, None]
    for after, before in zip(states, full, strict=True):
        assert (after.position[gone].abs() >= 12).all()
        assert torch.equal(after.position[~gone], before.position[~gone])
        assert torch.equal(after.lane, before.lane)


def test_who_assumes_cars_to_come_closer_supposes_it_of_those_seen_once(domain, generator):
    start = domain.initial(50, generator)
    seen = torch.rand(50, 4, generator=generator) < 0.5
    closing = torch.rand(50, generator=generator) < 0.5
    knowledge = after_one_step(domain, start, visual=seen)
    assumes = {"clear": torch.zeros(50).bool(), "closing": closing}
    supposed = domain.supposed(start, knowledge, assumes)
    unsure = seen & closing[:, None]
    assert torch.equal(supposed.position, start.position)
    assert torch.equal(supposed.speed[unsure], -start.position[unsure].sign())
    assert torch.equal(supposed.speed[~unsure], start.speed[~unsure])


def test_symbols_distinguish_all_observations(domain):
    cells = torch.arange(-12, 13)
    places = torch.cartesian_prod(cells, torch.tensor([0, 1]))
    now = DrivingState(places[:, 1], places[:, :1].expand(-1, 4), torch.ones(50, 4).long())
    observed = domain.observe(now)
    symbols = domain.symbols(observed)
    assert {name: value.shape[-1] for name, value in symbols.items()} == domain.symbol_sizes
    for name in ("visual", "verbal"):
        assert len(torch.unique(symbols[name][:, 0, :50], dim=0)) == 50
        assert torch.equal(symbols[name][..., :50].sum(-1), torch.ones(50, 4))
    assert torch.equal(
        symbols["verbal"][..., 50:].argmax(-1) - 1, observed["verbal"][..., 2].long()
    )
    assert torch.equal(symbols["ego"].argmax(-1), now.lane)


def test_reference_values_are_those_of_a_short_sum(domain):
    # Only rear-left, two cells behind and closing, meets this ego. Leaving at once costs a lane
    # change; staying costs a step at one cell, and the lane change one step later.
    start = state(0, (9, 9, -2, -9), speed=(1, 1, 1, -1))
    assert domain.reference_values(start, 1.0).tolist() == [-2 - 1, -1]
    assert domain.reference_values(start, 0.5).tolist() == [-2 - 0.5 * 1, -1]
    # In the other lane it never meets anybody, and switching only costs.
    aside = state(1, (9, 9, -2, -9), speed=(1, 1, 1, -1))
    assert domain.reference_values(aside, 1.0).tolist() == [0, -1 - 2 - 1]


# --- batches, pictures, names -------------------------------------------------------------------


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


def test_picture_shows_every_car_in_its_cell(domain):
    shown = state(1, (3, -5, 0, 12))
    picture = domain.render(shown)
    assert picture.dtype == np.uint8
    lanes, cells, size = 2, 25, 16
    assert picture.shape == (lanes * size, cells * size, 3)
    middles = picture[size // 2 :: size, size // 2 :: size].astype(int)
    red = (middles[..., 0] - middles[..., 2]) > 100
    blue = (middles[..., 2] - middles[..., 0]) > 100
    cars = [(CAR_LANES[i], shown.position[i].item() + 12) for i in range(3)]  # the last is off
    assert sorted(map(tuple, np.argwhere(red).tolist())) == sorted(cars)
    assert np.argwhere(blue).tolist() == [[1, 12]]


def test_names_are_checked(domain):
    assert get_domain("driving") is DOMAINS["driving"]
    with pytest.raises(UnknownNameError, match='unknown domain "drivin".*driving'):
        get_domain("drivin")
    with pytest.raises(UnknownNameError, match='unknown setting "snow".*clear, fog'):
        domain.visibility("snow", domain.observe(state(0, (1, 1, -1, -1))))
    assert domain.reward_terms == TERMS
    with pytest.raises(ValueError, match="needs a unit and a scale"):
        Modality("visual", ("car",), ("distance",), ("cells", "lanes"), (1.0,), 0.0)

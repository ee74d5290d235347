"""Driving: what is seen, said and assumed, against numbers from the supplement."""

import numpy as np
import pytest
import torch
from example_driving import rollout, same, state

from mirror_ppl.domains.checking import faults_of
from mirror_ppl.domains.driving import CAR_LANES, Driving, DrivingState


@pytest.fixture
def domain():
    return Driving()


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


@pytest.mark.parametrize(
    ("position", "speed", "possible"),
    [(11, 1.0, True), (-3, -1.0, True), (12, 0.0, True), (-12, 0.0, True)]
    + [(11, 0.0, False), (0, 0.0, False), (12, 1.0, False), (3, 0.5, False), (3, 2.0, False)],
)
def test_cars_have_a_speed_as_long_as_they_are_on_the_road(domain, position, speed, possible):
    observed = domain.observe(state(1, (position, 12, -11, -17), speed=(-1, 1, 1, -1)))
    verbal = observed["verbal"].clone()
    verbal[0, 2] = speed
    broken = [name for name, now in domain.faults({**observed, "verbal": verbal}).items() if now]
    rule = "relative_speed has to be -1 or 1, and 0 of cars 12 cells away"
    assert broken == [rule] * (not possible)


def test_symbols_that_depend_on_other_items_are_a_fault(domain):
    assert faults_of(domain) == []

    class Mixing(type(domain)):
        def symbols(self, observation):
            found = super().symbols(observation)
            return {**found, "verbal": found["verbal"].cumsum(-2)}

    assert "symbols: verbal of an item has to depend on that item" in faults_of(Mixing())[0]


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

"""The domain: observations, what is seen and can be said, pictures, names."""

import re

import numpy as np
import pytest
import torch
from highway_states import state_of

from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.highway import DirectHighway, Highway
from mirror_ppl.domains.highway.lidar import RANGE, SECTORS
from mirror_ppl.domains.highway.pictures import ACROSS, BEHIND, CAR, EGO, SCALE, UNSEEN
from mirror_ppl.domains.highway.road import OTHERS
from mirror_ppl.domains.highway.speech import DIRECTIONS, NOTHING
from mirror_ppl.errors import InputError, UnknownNameError

WORLD = DirectHighway()


def test_shapes_are_those_of_the_contract(generator):
    state = map_state(
        lambda part: part.reshape(2, 5, *part.shape[1:]), WORLD.initial(10, generator)
    )
    seen = WORLD.observe(state)
    assert seen["ego"].shape == (2, 5, len(WORLD.ego_features)) == (2, 5, len(WORLD.ego_units))
    for modality in WORLD.modalities:
        shape = (2, 5, len(modality.items), len(modality.features))
        assert seen[modality.name].shape == shape
        assert WORLD.visibility("fog", seen)[modality.name].shape == shape[:3]
    assert state.x.shape == (2, 5, 1 + OTHERS)


def test_the_ego_by_hand():
    controls = torch.tensor([0.25, -0.5], dtype=torch.float64)
    state = state_of((3.0, 7.5, 0.1, 9.0), controls=controls)
    expected = [2.0, -0.5, 0.1, 9.0, 0.25, -0.5, 0.0]
    assert WORLD.observe(state)["ego"].tolist() == pytest.approx(expected)


def test_everything_is_seen_in_clear_and_little_in_fog():
    def seen(setting, *cars):
        state = state_of((0.0, 4.0, 0.0, 10.0), cars)
        return WORLD.visibility(setting, WORLD.observe(state))["visual"]

    assert seen("clear").all() and not seen("fog").any()
    for x, expected in ((17.4, True), (17.6, False)):  # 15 m to its rear
        assert seen("fog", (x, 4.0, 0.0, 10.0))[0].item() is expected
    for x, expected in ((-7.4, True), (-7.6, False)):  # 5 m to its front
        assert seen("fog", (x, 4.0, 0.0, 10.0))[18].item() is expected
    beside = seen("fog", (0.0, 8.0, 0.0, 10.0))
    assert beside[6:13].all() and not beside[14:].any()


def test_sentences_are_only_heard():
    state = state_of(cars=[(20.0, 4.0, 0.0, 5.0)])
    for setting in WORLD.settings:
        assert not WORLD.visibility(setting, WORLD.observe(state))["verbal"].any()
    now = WORLD.observe(state)
    assert WORLD.describe(now, "verbal", "front") == '"Car ahead, approaching fast"'
    assert WORLD.describe(now, "verbal", "rear") == '"Nothing behind"'
    assert WORLD.describe(now, "visual", "front") == "front: car at 18 m, coming closer at 5 m/s"
    assert WORLD.describe(now, "visual", "180 degrees") == "180 degrees: no car within 60 m"


def test_what_cars_do_is_said_from_the_driver_on():
    found = []
    for item, car in (
        ("front", (20.0, 4.0, 0.0, 13.0)),
        ("rear", (-20.0, 4.0, 0.0, 13.0)),
        ("front-right", (9.0, 8.0, 0.0, 10.0)),
    ):
        now = WORLD.observe(state_of((0.0, 4.0, 0.0, 10.0), [car]))
        found.append(WORLD.describe(now, "visual", item))
    assert found == [
        "front: car at 18 m, drawing away at 3 m/s",
        "rear: car at 18 m, coming closer at 3 m/s",
        "front-right: car at 7 m, as fast as you",
    ]
    beside = WORLD.observe(state_of())
    for sectors, group in (((9, "90 degrees"), "rear-right"), ((27, "270 degrees"), "rear-left")):
        number, item = sectors
        outwards = 1.0 if number == 9 else -1.0
        for motion, words in (
            ((5.0, 0.0), "overtaking you"),
            ((-5.0, 0.0), "falling back"),
            ((0.0, -3.6 * outwards), "coming closer at 4 m/s"),
            ((0.0, 3.6 * outwards), "drawing away at 4 m/s"),
            ((0.0, 0.0), "as fast as you"),
        ):
            now = {name: value.clone() for name, value in beside.items()}
            now["visual"][number] = torch.tensor([3.0, *motion])
            assert WORLD.describe(now, "visual", item) == f"{item}: car at 3 m, {words}"
            assert WORLD.describe(now, "visual", group) == f"{group}: car at 3 m, {words}"
    deeds = [Highway().deed(now, None, action) for action in (0, 5, 6, 11)]
    assert deeds == [
        "stop in the left lane",
        "go slowly in the middle lane",
        "go at medium speed in the middle lane",
        "go fast in the right lane",
    ]


@pytest.mark.parametrize(
    ("modality", "place", "value", "rule"),
    [
        ("ego", 3, 999.0, "speed of ego has to be from -1 to 20"),
        ("ego", 1, -40.0, "lane_offset of ego has to be from -15 to 15"),
        ("ego", 2, 100.0, "heading of ego has to be from -3.142 to 3.142"),
        ("ego", 4, 7.0, "steering of ego has to be from -1 to 1"),
        ("visual", 0, 70.0, "distance of visual has to be from 0 to 60"),
        ("visual", 1, 500.0, "velocity_along of visual has to be from -60 to 60"),
        ("verbal", 0, 0.5, "utterance of verbal has to be one of [0, 1, 2, 3, 4, 5]"),
    ],
)
def test_what_cannot_be_observed_is_named(generator, modality, place, value, rule):
    now = WORLD.observe(WORLD.initial(4, generator))
    assert not any(broken.any() for broken in WORLD.faults(now).values())
    now[modality] = now[modality].clone()
    now[modality][2, ..., place] = value
    broken = {name: where.tolist() for name, where in WORLD.faults(now).items() if where.any()}
    assert broken[rule] == [False, False, True, False]


def broken_by(now):
    return " ".join(rule for rule, where in WORLD.faults(now).items() if bool(where))


def test_empty_sectors_have_no_velocity():
    now = WORLD.observe(state_of(cars=[(30.0, 4.0, 0.0, 8.0)]))
    assert broken_by(now) == ""
    visual = now["visual"].clone()
    visual[9, 1] = -2.0  # to the right, where the road ends much nearer
    assert broken_by({**now, "visual": visual}) == (
        "a sector with nothing within 60 m has to have the velocity 0"
    )
    # A car whose near end is a centimetre within the range: measured at 60 m, with its velocity.
    edge = WORLD.observe(state_of(cars=[(62.49, 4.0, 0.0, 8.0)]))
    assert edge["visual"][0].tolist() == [RANGE, -2.0, 0.0]
    assert broken_by(edge) == ""


@pytest.mark.parametrize(
    ("car", "direction", "certain"),
    [
        ((10.0, 4.0, 0.0, 8.0), "front", True),
        ((-10.0, 4.0, 0.0, 8.0), "rear", True),
        ((8.0, 8.0, 0.0, 12.0), "front-right", True),
        ((40.0, 4.0, 0.0, 8.0), "front", False),  # a sector is wider than a lane there
        ((8.0, 6.0, 0.0, 8.0), "front", False),  # between two lanes
        ((0.5, 8.0, 0.0, 10.0), "front-right", False),  # or a bit behind
    ],
)
def test_nothing_is_not_said_of_a_direction_with_a_car(car, direction, certain):
    beside = [(30.0, 0.0, 0.0, 9.0), (30.0, 8.0, 0.0, 9.0)] if direction == "front" else []
    now = WORLD.observe(state_of(cars=[car, *beside]))
    assert broken_by(now) == ""
    verbal = now["verbal"].clone()
    assert verbal[DIRECTIONS.index(direction), 0] != NOTHING
    verbal[DIRECTIONS.index(direction)] = NOTHING
    rule = "a direction in which the lidar sees a car must not have the sentence that nothing is"
    assert (rule in broken_by({**now, "verbal": verbal})) == certain
    if direction == "front":  # a car must be somewhere ahead, if in no direction for certain
        verbal[[DIRECTIONS.index(side) for side in ("front-left", "front-right")]] = NOTHING
        assert rule in broken_by({**now, "verbal": verbal})


def test_rounds_never_break_the_rules_of_observations(generator):
    now = WORLD.initial(200, generator)
    for _ in range(30):
        broken = {name for name, where in WORLD.faults(WORLD.observe(now)).items() if where.any()}
        assert broken == set()
        action = torch.rand(200, 2, generator=generator) * 2 - 1
        now = WORLD.transition(now, action * torch.tensor([0.2, 1.0]))


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.tensor([0.1]), "finite numbers [..., 2], not [0.1"),
        (torch.tensor([torch.nan, 0.0]), "finite numbers [..., 2], not [nan, 0.0]"),
        (torch.zeros(3, 5), "finite numbers [..., 2], not "),
        (torch.tensor(12), "count from 0 to 11, not 12"),
        (torch.tensor([-1, 2]), "count from 0 to 11, not [-1, 2]"),
        (torch.tensor([True, False]), "an action of the highway is a tensor of manoeuvres"),
        (torch.tensor([1j, 0j]), "an action of the highway is a tensor of manoeuvres"),
        (3, "an action of the highway is a tensor of manoeuvres"),
    ],
)
def test_actions_of_another_kind_are_refused(generator, action, message):
    state = WORLD.initial(2, generator)
    for function in (WORLD.transition, lambda s, a: WORLD.rewards(s, a, s)):
        with pytest.raises(InputError, match=re.escape(message)):
            function(state, action)


@pytest.mark.parametrize("kind", [torch.uint8, torch.int8, torch.int16, torch.int32])
def test_manoeuvres_are_whole_numbers_of_any_kind(generator, kind):
    state = WORLD.initial(12, generator)
    action = torch.ones(12, dtype=torch.long)
    found, expected = (WORLD.transition(state, one).x for one in (action.to(kind), action))
    assert torch.equal(found, expected)


def test_lanes_that_do_not_exist_are_not_spoken_of():
    left = WORLD.communicable(WORLD.observe(state_of((0.0, 0.0, 0.0, 10.0))))
    silent = [name for name, ok in zip(DIRECTIONS, left["verbal"], strict=True) if not ok]
    assert silent == ["rear-left", "front-left"] and left["visual"].all()
    right = WORLD.communicable(WORLD.observe(state_of((0.0, 8.0, 0.0, 10.0))))
    silent = [name for name, ok in zip(DIRECTIONS, right["verbal"], strict=True) if not ok]
    assert silent == ["front-right", "rear-right"]


def test_unknown_settings_are_refused():
    with pytest.raises(UnknownNameError, match="clear, fog"):
        WORLD.visibility("snow", WORLD.observe(state_of()))


def test_scenarios_are_drawn_or_given(generator):
    """Each of nine scenarios has about 100 of 900 rounds; cars that play a part show which."""
    state = WORLD.initial(900, generator)
    crawls = (state.cruise[:, 1] < 4).sum().item()
    assert abs(crawls - 100) < 4 * (900 * 8 / 81) ** 0.5
    index = torch.full((5,), WORLD.scenarios.index("car ahead crawls"))
    assert (WORLD.initial(5, generator, index).cruise[:, 1] < 4).all()


def test_a_picture_has_cars_where_they_are():
    state = state_of((0.0, 4.0, 0.0, 10.0), [(20.0, 8.0, 0.0, 10.0), (-30.0, 0.0, 0.0, 10.0)])
    image = WORLD.render(state)
    assert image.dtype == np.uint8 and image.shape[2] == 3
    for x, y, colour in ((0, 4, EGO), (20, 8, CAR), (-30, 0, CAR)):
        row, column = int((y - ACROSS[0]) * SCALE), int((x + BEHIND) * SCALE)
        assert tuple(image[row, column]) == colour
        assert tuple(image[row, column + 4 * SCALE]) not in (EGO, CAR)


def test_a_picture_shows_what_is_hidden():
    state = state_of((0.0, 4.0, 0.0, 10.0), [(14.0, 4.0, 0.0, 10.0)])

    def hidden(setting):
        return (WORLD.render(state, setting) == UNSEEN).all(-1).sum()

    assert hidden("clear") == 0 < hidden("fog")


def test_sectors_are_in_range(generator):
    seen = WORLD.observe(WORLD.initial(50, generator))["visual"]
    assert seen.shape[1] == SECTORS
    assert (seen[..., 0] > 0).all() and (seen[..., 0] <= RANGE).all()
    assert (seen[..., 1:][seen[..., 0] == RANGE] == 0).all()

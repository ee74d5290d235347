"""The domain: observations, what is seen and can be said, pictures, names."""

import numpy as np
import pytest
import torch
from highway_states import state_of

from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.highway import DirectHighway
from mirror_ppl.domains.highway.lidar import RANGE, SECTORS
from mirror_ppl.domains.highway.pictures import ACROSS, BEHIND, CAR, EGO, SCALE, UNSEEN
from mirror_ppl.domains.highway.road import OTHERS
from mirror_ppl.domains.highway.speech import DIRECTIONS
from mirror_ppl.errors import UnknownNameError

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
    assert WORLD.describe(now, "verbal", "front") == "Car ahead, approaching fast."
    assert WORLD.describe(now, "verbal", "rear") == "Nothing behind."
    assert WORLD.describe(now, "visual", "front") == "front: car at 18 m, -5 m/s"
    assert WORLD.describe(now, "visual", "180 degrees") == "180 degrees: no car within 60 m"


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

"""Utterances: one state for each sentence, and words that lead back to it."""

from dataclasses import replace

import pytest
import torch
from highway_states import state_of

from mirror_ppl.domains.highway.lidar import RANGE
from mirror_ppl.domains.highway.messages import SPOKEN
from mirror_ppl.domains.highway.speech import (
    DIRECTIONS,
    FAST,
    NOTHING,
    PLACES,
    UTTERANCES,
    WORDS,
    utterances,
)

EGO = 10.0
PLACE = {
    "front": (20.0, 4.0),
    "front-right": (20.0, 8.0),
    "rear-right": (-20.0, 8.0),
    "rear": (-20.0, 4.0),
    "rear-left": (-20.0, 0.0),
    "front-left": (20.0, 0.0),
}


def said(*cars, braking=(), **fields):
    state = state_of((0.0, 4.0, 0.0, EGO), cars, **fields)
    slowing = state.acceleration.clone()
    for number, rate in braking:
        slowing[number] = -rate
    return utterances(replace(state, acceleration=slowing)).tolist()


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize(
    ("growing", "words"),
    [
        (-FAST - 0.1, "approaching fast"),
        (-FAST + 0.1, "approaching slowly"),
        (-0.1, "approaching slowly"),
        (0.0, "moving away slowly"),
        (FAST - 0.1, "moving away slowly"),
        (FAST + 0.1, "moving away fast"),
    ],
)
def test_each_direction_has_its_sentence(direction, growing, words):
    x, y = PLACE[direction]
    speed = EGO + (growing if x > 0 else -growing)
    found = said((x, y, 0.0, speed))
    index = DIRECTIONS.index(direction)
    assert found.pop(index) == WORDS.index(words)
    assert found == [NOTHING] * 5


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_braking_comes_before_everything_else(direction):
    index = DIRECTIONS.index(direction)
    car = (*PLACE[direction], 0.0, EGO - 5)
    assert said(car, braking=[(1, 2.0)])[index] == WORDS.index("braking")
    assert said(car, braking=[(1, 1.9)])[index] != WORDS.index("braking")


def test_the_nearest_car_of_a_lane_counts():
    near, far = (15.0, 4.0, 0.0, EGO + 5), (40.0, 4.0, 0.0, EGO - 5)
    assert said(far, near)[0] == WORDS.index("moving away fast")
    # The car that brakes is not the nearest one.
    assert said(far, near, braking=[(1, 6.0)])[0] == WORDS.index("moving away fast")


def test_abreast_is_ahead_and_out_of_range_is_nothing():
    assert said((0.0, 8.0, 0.0, EGO))[1] != NOTHING
    assert said((-0.1, 8.0, 0.0, EGO))[1:3] == [NOTHING, WORDS.index("moving away slowly")]
    assert said((RANGE + 0.1, 4.0, 0.0, 1.0)) == [NOTHING] * 6
    assert said((RANGE - 0.1, 4.0, 0.0, 1.0))[0] == WORDS.index("approaching fast")


def test_cars_two_lanes_away_are_not_spoken_of():
    state = state_of((0.0, 0.0, 0.0, EGO), [(20.0, 8.0, 0.0, 1.0)])
    assert utterances(state).tolist() == [NOTHING] * 6


def test_words_are_the_sentences_of_the_modality():
    sentences = [sentence for about in UTTERANCES for sentence in about]
    assert len(set(sentences)) == 36
    for item, (place, about) in enumerate(zip(PLACES, UTTERANCES, strict=True)):
        assert about[NOTHING] == f"Nothing {place}."
        for index, sentence in enumerate(about):
            assert SPOKEN.understand(sentence) == (item, index)


def test_utterances_are_of_any_batch():
    one = state_of(cars=[(20.0, 4.0, 0.0, 5.0)])
    many = type(one)(**{k: v.expand(2, 3, *v.shape) for k, v in vars(one).items()})
    assert torch.equal(utterances(many), utterances(one).expand(2, 3, 6))

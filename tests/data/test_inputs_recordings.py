"""Recordings from Python: arrays of any kind are taken, arguments of wrong kinds refused."""

import numpy as np
import pytest
import torch
from example_recordings import RAGGED, fields
from refused import refused

from mirror_ppl.data import Demonstrations, asset_path, concatenate, load_demonstrations
from mirror_ppl.data.schema import A_NAME


@pytest.fixture
def given_fields():
    return fields(RAGGED)


@pytest.fixture
def ragged(given_fields):
    return Demonstrations(**given_fields)


def anything(value, change):
    """Each tensor of arguments changed, in dicts too."""
    if isinstance(value, torch.Tensor):
        return change(value)
    if isinstance(value, dict):
        return {name: anything(part, change) for name, part in value.items()}
    return value


KINDS = {
    "numpy": lambda value: value.numpy(),
    "numpy of float64": lambda value: value.numpy().astype(np.float64),
    "numpy of other byte order": lambda value: value.numpy().astype(">f4"),
    "numpy backwards in memory": lambda value: value.flip(0).numpy()[::-1],
    "lists": lambda value: value.tolist(),
    "float64": lambda value: value.double(),
    "with gradients": lambda value: value.double().requires_grad_(),
    "masked arrays without a mask": lambda value: np.ma.array(value.numpy()),
}


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())
def test_arrays_of_any_kind_make_the_same_recordings(given_fields, ragged, kind):
    assert Demonstrations(**anything(given_fields, kind)).equals(ragged)
    variables = anything(ragged.variables(), kind)
    ids = np.array(ragged.people)
    made = Demonstrations.from_variables("driving", "fog", ids, variables, ragged.provenance)
    assert made.equals(ragged) and {type(one) for one in made.people} == {str}


def test_arrays_of_numpy_are_copied(given_fields):
    own = anything(given_fields, KINDS["numpy"])
    made = Demonstrations(**own)
    before = made.select_people(range(3))
    for value in (own["ego"], own["actions"], own["truth"]["reach"], own["told"]["visual"]):
        value[:] = 0
    assert made.equals(before)


def test_what_numpy_lacks_is_taken_as_absent(ragged):
    """Without round_count and length, everybody has all rounds of all steps."""
    variables = ragged.select_people(["a"]).select_rounds([0]).variables()
    full = {name: variables[name].numpy() for name in ("ego", "visual", "verbal", "action")}
    made = Demonstrations.from_variables("driving", "fog", ["a"], full)
    assert made.lengths.tolist() == [[3]] and made.round_counts.tolist() == [1]


def masked(value):
    return np.ma.array(value.numpy(), mask=value.numpy() > 0)


WRONG = {
    "text": ({"ego": np.full((3, 3, 5, 1), "x")}, "ego is ndarray of shape (3, 3, 5, 1) of <U1"),
    "objects": ({"rewards": [None, 1]}, "reward is list of object, expected an array"),
    "nothing": ({"ego": None}, "ego is None, expected an array of numbers"),
    "no actions": ({"actions": None}, "action is None, expected an array of numbers"),
    "lists of several lengths": ({"ego": [[1], [1, 2]]}, "ego is list, expected an array of"),
    "complex": (
        {"ego": torch.zeros(3, 3, 5, 1) * 1j},
        "torch.complex64, torch.strided, expected",
    ),
    "sparse": ({"ego": torch.zeros(3, 3, 5, 1).to_sparse()}, "torch.sparse_coo, expected numbers"),
    "masked": ({"ego": masked(torch.ones(3, 3, 5, 1))}, "ego has masked entries, expected"),
    "a dict of truths": ({"truth": [1.0]}, "truth must be a dict of values by name, not [1.0]"),
    "one truth": ({"truth": {"reach": 1.0}}, "truth_reach has shape (), expected (3,)"),
    "observations": ({"observations": [1]}, "must be a dict with visual, verbal, not [1]"),
    "told": ({"told": torch.zeros(3)}, "a dict with visual, verbal, not Tensor of shape (3,)"),
    "ids that are no list": ({"people": 3}, "people must be a list of ids, not 3"),
    "ids that are arrays": ({"people": (np.zeros((2, 2)), "b", "c")}, f"(2, 2), expected {A_NAME}"),
    "domain": ({"domain": 3}, "unknown domain 3; known: bomb_defusal, driving"),
    "a list of domains": ({"domain": ["driving"]}, "unknown domain ['driving']; known: "),
    "setting": ({"setting": None}, "unknown setting None in driving; known: clear, fog"),
    "setting of two lines": ({"setting": "a\nb"}, r"unknown setting 'a\nb' in driving; known: "),
    "setting without end": ({"setting": "a" * 101}, f"unknown setting '{'a' * 40}'... in driving"),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG.keys())
def test_wrong_kinds_are_refused(given_fields, change, message):
    refused(lambda: Demonstrations(**(given_fields | change)), message)


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        (3, "variables must be a dict of arrays, not 3"),
        ({"action": np.zeros((3, 3, 4))}, "the variable ego is missing"),
        ({"action": np.zeros((3, 4))}, "action has shape (3, 4), expected people, rounds and"),
        ({"action": "stay"}, "action is 'stay', expected an array of numbers"),
        ({"round_count": [3, 0]}, "round_count has shape (2,), expected (3,) (person 3)"),
        ({"round_count": None}, "round_count is None, expected an array of numbers"),
        ({"told_smell": np.zeros(2)}, "told has visual, verbal, smell, expected visual, verbal"),
    ],
)
def test_wrong_variables_are_refused(ragged, variables, message):
    if isinstance(variables, dict) and "missing" not in message:
        variables = ragged.variables() | variables
    make = Demonstrations.from_variables
    refused(lambda: make("driving", "fog", ragged.people, variables), message)


@pytest.mark.parametrize(
    "people",
    [
        [2, 0],
        (2, 0),
        np.array([2, 0]),
        np.array([2, 0], dtype=np.uint8),
        torch.tensor([2, 0]),
        [np.int64(2), torch.tensor(0)],
        np.array(["c", "a"]),
        (name for name in "ca"),
    ],
)
def test_people_are_selected_by_lists_of_any_kind(ragged, people):
    assert ragged.select_people(people).equals(ragged.select_people(["c", "a"]))


NOT_PEOPLE = {
    "one id": ("a", "people must be a list of ids or indices, not 'a'"),
    "one index": (0, "people must be a list of ids or indices, not 0"),
    "a slice": (slice(1), "a list of ids or indices, not slice(None, 1, None)"),
    "a dict": ({"a": 1}, "people must be a list of ids or indices, not dict"),
    "half a person": ([0.5], "the number of a person must be a whole number, not 0.5"),
    "none": ([None], "the number of a person must be a whole number, not None"),
    "a mask": (np.array([True, False, True]), "must be a whole number, not True"),
    "a row of people": (np.zeros((1, 2), int), "must be a whole number, not [0, 0]"),
    "the last": ([-1], "there is no person -1, expected one of 3, counted from 0"),
    "an id of two lines": (["a\nb"], r"unknown person 'a\nb'; known: a, b, c"),
    "an id without end": (["a" * 9999], f"unknown person '{'a' * 40}'...; known: a, b, c"),
}


@pytest.mark.parametrize(("people", "message"), NOT_PEOPLE.values(), ids=NOT_PEOPLE.keys())
def test_wrong_people_are_refused(ragged, people, message):
    refused(lambda: ragged.select_people(people), message)


@pytest.mark.parametrize("rounds", [range(2), np.array([0, 1]), torch.tensor([0, 1]), slice(0, 2)])
def test_rounds_are_selected_by_lists_of_any_kind(ragged, rounds):
    assert ragged.select_rounds(rounds).equals(ragged.select_rounds([0, 1]))


NOT_ROUNDS = {
    "one": (1, "rounds must be a list of numbers, or a slice, not 1"),
    "text": ("01", "rounds must be a list of numbers, or a slice, not '01'"),
    "nothing": (None, "rounds must be a list of numbers, or a slice, not None"),
    "half a round": ([0.5], "the number of a round must be a whole number, not 0.5"),
    "a mask": ([True, False, True], "the number of a round must be a whole number, not True"),
    "half a slice": (slice(0.5), "rounds must be a slice of whole numbers, not slice(None, 0.5"),
    "a round twice": ([1, 0, 1, 0], "round 1 is selected more than once"),
    "a slice of no step": (slice(None, None, 0), "not slice(None, None, 0) (slice step cannot be"),
}


@pytest.mark.parametrize(("rounds", "message"), NOT_ROUNDS.values(), ids=NOT_ROUNDS.keys())
def test_wrong_rounds_are_refused(ragged, rounds, message):
    refused(lambda: ragged.select_rounds(rounds), message)


def test_parts_of_any_list_are_put_together(ragged):
    parts = [ragged.select_people([name]) for name in "abc"]
    assert concatenate(part for part in parts).equals(ragged)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (3, "parts must be a list of demonstrations, not 3"),
        ([3], "parts must be demonstrations, not 3"),
        ("recordings.nc", "parts must be a list of demonstrations, not 'recordings.nc'"),
    ],
)
def test_other_parts_are_refused(parts, message):
    refused(lambda: concatenate(parts), message)


def test_recordings_are_not_a_list_of_recordings(ragged):
    refused(lambda: concatenate(ragged), "not Demonstrations of shape (3, 3, 4)")


def test_a_device_that_is_not_there_is_refused(ragged):
    refused(lambda: ragged.to("gpu9"), 'unknown device "gpu9"; known: cpu')


def test_files_are_named_by_text_or_path():
    path = asset_path("driving_fog_paper.nc")
    assert load_demonstrations(str(path)).equals(load_demonstrations(path))
    refused(lambda: load_demonstrations(3), "path must be the path of a file, not 3")
    refused(lambda: asset_path(3), "name must be the path of a file, not 3")

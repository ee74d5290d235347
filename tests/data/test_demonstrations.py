"""Recordings: what is refused, what is kept, and what is made of them."""

import dataclasses
import math
import pickle

import numpy as np
import pytest
import torch
from example_recordings import NAN, RAGGED, fields

from mirror_ppl.data import Demonstrations, concatenate
from mirror_ppl.data.schema import A_NAME
from mirror_ppl.errors import DemonstrationsError, UnknownNameError


@pytest.fixture
def given_fields():
    return fields(RAGGED)


@pytest.fixture
def ragged(given_fields):
    return Demonstrations(**given_fields)


# --- creation ---------------------------------------------------------------------------------


def test_padding_is_brought_into_one_form_and_the_rest_is_kept(given_fields, ragged):
    assert (ragged.num_people, ragged.shape) == (3, (3, 3, 4))
    assert (
        repr(ragged)
        == "Demonstrations(driving, fog: 3 people, 0 to 3 rounds each, 11 steps in all)"
    )
    for p in range(3):
        for b in range(3):
            n = RAGGED[p][b] if b < len(RAGGED[p]) else 0
            seen = n + 1 if n else 0
            assert ragged.mask[p, b].tolist() == [True] * n + [False] * (4 - n)
            for field, end, padding in (
                ("actions", n, -1),
                ("rewards", n, NAN),
                ("action_entropy", n, NAN),
                ("ego", seen, NAN),
            ):
                value, before = getattr(ragged, field)[p, b], given_fields[field][p, b]
                torch.testing.assert_close(value[:end], before[:end], rtol=0, atol=0)
                expected = torch.full_like(value[end:], padding)
                torch.testing.assert_close(value[end:], expected, equal_nan=True)
            for name in ("visual", "verbal"):
                observed, before = ragged.observations[name], given_fields["observations"][name]
                assert torch.equal(observed[p, b, :seen], before[p, b, :seen])
                assert observed[p, b, seen:].isnan().all()
                told, before = ragged.told[name], given_fields["told"][name]
                assert told.dtype == torch.bool and not told[p, b, n:].any()
                assert torch.equal(told[p, b, :n], before[p, b, :n].bool())
            assert ragged.scenarios[p, b] == (given_fields["scenarios"][p, b] if n else -1)


def test_arrays_are_copies_and_fields_are_frozen(given_fields):
    full = fields([[2, 2]])
    made = Demonstrations(**full)
    before = made.select_people([0])
    for name in ("ego", "actions", "lengths", "round_counts", "rewards"):
        full[name].fill_(1)
    full["truth"]["reach"].fill_(1)
    full["observations"]["visual"].fill_(1)
    full["told"].clear()
    assert made.equals(before)
    with pytest.raises(dataclasses.FrozenInstanceError):
        made.setting = "clear"


def test_optional_fields_may_be_absent_and_there_are_no_messages_by_default(given_fields):
    for name in ("told", "rewards", "scenarios", "truth", "action_entropy", "provenance"):
        del given_fields[name]
    made = Demonstrations(**given_fields)
    assert made.rewards is None and made.scenarios is None and made.action_entropy is None
    assert made.truth == {} and made.provenance == {}
    assert {name: value.shape for name, value in made.told.items()} == {
        "visual": (3, 3, 4, 4),
        "verbal": (3, 3, 4, 4),
    }
    assert not any(value.any() for value in made.told.values())


@pytest.mark.parametrize("dtype", [torch.int8, torch.int32, torch.float32, torch.float64])
def test_any_numeric_dtype_will_do(given_fields, ragged, dtype):
    for name in ("actions", "lengths", "round_counts", "scenarios"):
        given_fields[name] = given_fields[name].to(dtype)
    given_fields["told"] = {key: value.to(dtype) for key, value in given_fields["told"].items()}
    given_fields["ego"] = given_fields["ego"].double()
    assert Demonstrations(**given_fields).equals(ragged)


def put(path, index, value):
    """A change of one entry (index) or of a whole field (index None) of the arguments."""

    def change(arguments):
        place = arguments
        for key in path[:-1]:
            place = place[key]
        if index is None:
            place[path[-1]] = value
        else:
            place[path[-1]] = place[path[-1]].double()
            place[path[-1]][index] = value

    return change


BAD = {
    "nan inside a round": (
        put(["observations", "visual"], (2, 1, 4, 3, 0), NAN),
        "person 'c', round 1, time 4: visual of rear-right, distance_ahead is nan, "
        "expected a finite number",
    ),
    "infinity inside a round": (
        put(["ego"], (0, 0, 1, 0), float("inf")),
        "person 'a', round 0, time 1: ego of lane is inf, expected a finite number",
    ),
    "reward nan": (
        put(["rewards"], (2, 2, 0), NAN),
        "person 'c', round 2, step 0: reward is nan, expected a finite number",
    ),
    "entropy infinite": (
        put(["action_entropy"], (2, 2, 0), float("inf")),
        "person 'c', round 2, step 0: action_entropy is inf, "
        "expected from 0 to 0.6931 (log of 2 actions), or nan if unknown",
    ),
    "entropy negative": (
        put(["action_entropy"], (2, 2, 0), -0.002),
        "person 'c', round 2, step 0: action_entropy is -0.002, "
        "expected from 0 to 0.6931 (log of 2 actions), or nan if unknown",
    ),
    "entropy of more actions than there are": (
        put(["action_entropy"], (0, 0, 1), 0.695),
        "person 'a', round 0, step 1: action_entropy is 0.695, "
        "expected from 0 to 0.6931 (log of 2 actions), or nan if unknown",
    ),
    "truth infinite": (
        put(["truth", "reach"], (1,), float("-inf")),
        "person 'b': truth_reach is -inf, expected a finite number, or nan if unknown",
    ),
    "action too large": (
        put(["actions"], (2, 1, 3), 2),
        "person 'c', round 1, step 3: action is 2, "
        "expected a whole number from 0 to 1 (stay, switch)",
    ),
    "action missing": (
        put(["actions"], (0, 1, 0), -1),
        "person 'a', round 1, step 0: action is -1, "
        "expected a whole number from 0 to 1 (stay, switch); "
        "if the round is padding, round_count has to be the person's number of rounds",
    ),
    "padding that length does not mark": (
        put(["actions"], (2, 1, slice(2, None)), -1),
        "person 'c', round 1, step 2: action is -1, "
        "expected a whole number from 0 to 1 (stay, switch); "
        "if this is padding, length has to be the round's number of actions",
    ),
    "observations of padding that length does not mark": (
        put(["ego"], (2, 1, slice(3, None)), NAN),
        "person 'c', round 1, time 3: ego of lane is nan, expected a finite number; "
        "if this is padding, length has to be the round's number of actions",
    ),
    "actions missing in the middle, which is no padding": (
        put(["actions"], (2, 1, slice(1, 3)), -1),
        "person 'c', round 1, step 1: action is -1, "
        "expected a whole number from 0 to 1 (stay, switch)",
    ),
    "half an action": (
        put(["actions"], (0, 1, 0), 0.5),
        "person 'a', round 1, step 0: action is 0.5, "
        "expected a whole number from 0 to 1 (stay, switch)",
    ),
    "told twice": (
        put(["told", "verbal"], (0, 0, 2, 1), 2),
        "person 'a', round 0, step 2: told_verbal of front-right is 2, "
        "expected a whole number from 0 to 1",
    ),
    "unknown scenario": (
        put(["scenarios"], (2, 2), 8),
        "person 'c', round 2: scenario is 8, expected a whole number from -1 to 7 (-1 if unknown)",
    ),
    "round of length zero": (
        put(["lengths"], (2, 1), 0),
        "person 'c', round 1: length is 0, expected at least 1 (padding begins at round_count)",
    ),
    "round beyond the count": (
        put(["lengths"], (1, 0), 2),
        "person 'b', round 0: length is 2, expected 0 (padding begins at round_count)",
    ),
    "round too long": (
        put(["lengths"], (2, 1), 5),
        "person 'c', round 1: length is 5, expected a whole number from 0 to 4",
    ),
    "too many rounds": (
        put(["round_counts"], (1,), 4),
        "person 'b': round_count is 4, expected a whole number from 0 to 3",
    ),
    "wrong number of items": (
        put(["observations", "visual"], None, torch.zeros(3, 3, 5, 3, 2)),
        "visual has shape (3, 3, 5, 3, 2), expected (3, 3, 5, 4, 2) "
        "(person 3, round 3, time 5, visual_item 4, visual_feature 2)",
    ),
    "as many observations as actions": (
        put(["ego"], None, torch.zeros(3, 3, 4, 1)),
        "ego has shape (3, 3, 4, 1), expected (3, 3, 5, 1) "
        "(person 3, round 3, time 5, ego_feature 1)",
    ),
    "lengths without people": (
        put(["lengths"], None, torch.ones(3)),
        "length has shape (3,), expected (3, 3) (person 3, round 3)",
    ),
    "truth of another number of people": (
        put(["truth", "reach"], None, torch.ones(2)),
        "truth_reach has shape (2,), expected (3,) (person 3)",
    ),
    "actions without rounds": (
        put(["actions"], None, torch.zeros(3, 0, 4)),
        "action has shape (3, 0, 4), expected people, rounds and steps, at least one of each",
    ),
    "modality missing": (
        put(["observations"], None, {"visual": torch.zeros(3, 3, 5, 4, 2)}),
        "observations has visual, expected visual, verbal",
    ),
    "modality unknown": (
        put(["told"], None, {"smell": torch.zeros(3, 3, 4, 4)}),
        "told has smell, expected visual, verbal",
    ),
    "same id twice": (
        put(["people"], None, ("a", "b", "a")),
        "two people have the id 'a', expected unique ids",
    ),
    "empty id": (put(["people"], None, ("a", "", "c")), f"id is '', expected {A_NAME}"),
    "id that is a number": (put(["people"], None, ("a", 7, "c")), f"id is 7, expected {A_NAME}"),
    "id of two lines": (
        put(["people"], None, ("a", "b\nb", "c")),
        f"id is 'b\\nb', expected {A_NAME}",
    ),
    "id with half a character": (
        put(["people"], None, ("a", "b\udc80", "c")),
        f"id is 'b\\udc80', expected {A_NAME}",
    ),
    "long id": (
        put(["people"], None, ("a", "b" * 101, "c")),
        f"id is '{'b' * 40}'..., expected {A_NAME}",
    ),
    "ids that are one text": (put(["people"], None, "abc"), "must be a list of ids, not 'abc'"),
    "nobody": (put(["people"], None, ()), "there are no people, expected at least one person"),
    "truth that files cannot name": (
        put(["truth"], None, {"a/b": torch.ones(3)}),
        f"truth has 'a/b', expected {A_NAME}, no /",
    ),
    "truth without a name": (
        put(["truth"], None, {"": torch.ones(3)}),
        f"truth has '', expected {A_NAME}, no /",
    ),
    "truth of a long name": (
        put(["truth"], None, {"r" * 101: torch.ones(3)}),
        f"truth has '{'r' * 40}'..., expected {A_NAME}, no /",
    ),
    "truth whose name is a number": (
        put(["truth"], None, {3: torch.ones(3)}),
        f"truth has 3, expected {A_NAME}, no /",
    ),
    "provenance that is a description": (
        put(["provenance"], None, {"domain": "x"}),
        "provenance has domain, which describes the file itself",
    ),
    "provenance that is a list": (
        put(["provenance"], None, {"seed": [1]}),
        "provenance seed is [1], expected text or a number",
    ),
    "provenance that is no dict": (
        put(["provenance"], None, ["seed"]),
        "provenance must be a dict, not ['seed']",
    ),
    "provenance nan": (
        put(["provenance"], None, {"rate": NAN}),
        "provenance rate is nan, expected a finite number",
    ),
    "provenance infinite": (
        put(["provenance"], None, {"rate": np.float32("-inf")}),
        "provenance rate is -inf, expected a finite number",
    ),
    "provenance of more than 64 bits": (
        put(["provenance"], None, {"seed": 2**63}),
        "provenance seed is 9223372036854775808, expected a whole number of 64 bits",
    ),
    "provenance that files cannot hold": (
        put(["provenance"], None, {"command": "\udc80"}),
        "provenance command is '\\udc80', expected text that can be written in UTF-8",
    ),
    "provenance whose name is a number": (
        put(["provenance"], None, {3: 3}),
        "provenance has 3, expected names as text",
    ),
}


@pytest.mark.parametrize(("change", "message"), BAD.values(), ids=BAD.keys())
def test_bad_demonstrations_are_refused_in_one_line(given_fields, change, message):
    change(given_fields)
    with pytest.raises(DemonstrationsError) as error:
        Demonstrations(**given_fields)
    assert str(error.value).endswith(message)
    assert str(error.value).isprintable()


def test_values_at_the_edge_are_kept(given_fields):
    """Rounding may take an entropy out of its range; an id may have 100 characters."""
    entropies = torch.full((3, 3, 4), math.log(2) + 9e-4)
    entropies[0] = -9e-4
    given_fields |= {"action_entropy": entropies, "people": ("a", "b" * 100, "c d")}
    given_fields["truth"]["r" * 100] = torch.tensor([1e30, NAN, -1e30])
    given_fields["provenance"] = {"command": "a\nb", "seed": np.int64(3), "rate": np.float32(0.5)}
    made = Demonstrations(**given_fields)
    assert torch.equal(made.action_entropy[0, 0, :3], entropies[0, 0, :3])
    assert made.people == ("a", "b" * 100, "c d")
    assert made.provenance == {"command": "a\nb", "seed": 3, "rate": 0.5}
    assert [type(value) for value in made.provenance.values()] == [str, int, float]


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("domain", "drivin", 'unknown domain "drivin"'),
        ("setting", "rain", 'unknown setting "rain"'),
    ],
)
def test_unknown_domain_and_setting(given_fields, field, value, message):
    with pytest.raises(UnknownNameError, match=message):
        Demonstrations(**(given_fields | {field: value}))


# --- what is made of them ---------------------------------------------------------------------


def test_observation_is_finite_and_repeats_the_rounds_last(ragged):
    observation = ragged.observation()
    assert list(observation) == ["ego", "visual", "verbal"]
    raw = {"ego": ragged.ego, **ragged.observations}
    for name, value in observation.items():
        assert value.shape == raw[name].shape and value.isfinite().all()
        assert torch.equal(value[2, 1], raw[name][2, 1])  # as long as there is room
        assert torch.equal(value[0, 1, :2], raw[name][0, 1, :2])
        assert torch.equal(value[0, 1, 2:], raw[name][0, 1, 1].expand_as(value[0, 1, 2:]))
        assert not value[1].any() and not value[0, 2].any()


def test_select_people_by_id_and_by_index(ragged):
    chosen = ragged.select_people(["b", "a"])
    assert chosen.people == ("b", "a") and chosen.shape == (2, 2, 3)
    assert chosen.round_counts.tolist() == [0, 2] and chosen.lengths.tolist() == [[0, 0], [3, 1]]
    assert torch.equal(chosen.actions[1], ragged.actions[0, :2, :3])
    assert torch.equal(chosen.told["visual"][1], ragged.told["visual"][0, :2, :3])
    assert torch.equal(chosen.ego[1, 0], ragged.ego[0, 0, :4])
    assert torch.equal(chosen.truth["reach"], ragged.truth["reach"][[1, 0]])
    assert chosen.provenance == ragged.provenance
    assert chosen.equals(ragged.select_people([1, 0]))
    assert ragged.select_people([0, 1, 2]).equals(ragged)
    nothing = ragged.select_people(["b"])
    assert nothing.shape == (1, 1, 1) and not nothing.mask.any()


def test_select_people_refuses_what_is_not_there(ragged):
    with pytest.raises(UnknownNameError, match='unknown person "z"'):
        ragged.select_people(["z"])
    with pytest.raises(DemonstrationsError, match="there is no person 3, expected one of 3"):
        ragged.select_people([3])
    with pytest.raises(DemonstrationsError, match="two people have the id 'a'"):
        ragged.select_people([0, 0])
    with pytest.raises(DemonstrationsError, match="there are no people"):
        ragged.select_people([])


@pytest.mark.parametrize(
    ("rounds", "kept"),
    [
        (slice(0, 1), [[0], [], [0]]),
        (slice(-2, None), [[0, 1], [], [1, 2]]),
        (slice(1, 3), [[1], [], [1, 2]]),
        ([2, 0], [[0], [], [2, 0]]),
        ([2], [[], [], [2]]),
        ([], [[], [], []]),
    ],
)
def test_select_rounds_keeps_people_and_each_their_own_rounds(ragged, rounds, kept):
    chosen = ragged.select_rounds(rounds)
    assert chosen.people == ragged.people
    assert chosen.round_counts.tolist() == [len(row) for row in kept]
    lengths = [[RAGGED[p][b] for b in row] for p, row in enumerate(kept)]
    T = max([1, *(n for row in lengths for n in row)])
    assert chosen.shape == (3, max(1, *map(len, kept)), T)
    for p, row in enumerate(kept):
        for new, old in enumerate(row):
            n = RAGGED[p][old]
            assert chosen.lengths[p, new] == n and chosen.mask[p, new].sum() == n
            assert torch.equal(chosen.actions[p, new, :n], ragged.actions[p, old, :n])
            assert torch.equal(chosen.rewards[p, new, :n], ragged.rewards[p, old, :n])
            seen = chosen.observations["verbal"][p, new, : n + 1]
            assert torch.equal(seen, ragged.observations["verbal"][p, old, : n + 1])
            assert chosen.scenarios[p, new] == ragged.scenarios[p, old]
    assert torch.equal(chosen.truth["reach"], ragged.truth["reach"])


def test_select_rounds_refuses_what_nobody_has(ragged):
    for number in (3, -1):
        with pytest.raises(DemonstrationsError, match=f"no round {number}, expected one of 3"):
            ragged.select_rounds([0, number])


def test_concatenate_undoes_select_people(ragged):
    parts = [ragged.select_people([name]) for name in "abc"]
    assert concatenate(parts).equals(ragged)


def test_concatenate_fills_in_what_a_part_does_not_know(ragged, given_fields):
    for name in ("told", "rewards", "scenarios", "truth", "action_entropy"):
        del given_fields[name]
    given_fields |= {"people": ("d", "e", "f"), "provenance": {"seed": 3, "command": "other"}}
    both = concatenate([ragged, Demonstrations(**given_fields)])
    assert both.people == tuple("abcdef") and both.provenance == {"seed": 3}
    assert torch.equal(both.truth["reach"][:3], ragged.truth["reach"])
    assert both.truth["reach"][3:].isnan().all()
    assert torch.equal(both.scenarios[:3], ragged.scenarios) and (both.scenarios[3:] == -1).all()
    assert both.action_entropy[3:].isnan().all() and both.rewards is None


def test_concatenate_refuses_what_does_not_belong_together(ragged, given_fields):
    clear = Demonstrations(**(given_fields | {"setting": "clear"}))
    with pytest.raises(DemonstrationsError, match="driving, clear .* driving, fog"):
        concatenate([ragged, clear])
    with pytest.raises(DemonstrationsError, match="two people have the id 'a'"):
        concatenate([ragged, ragged])
    with pytest.raises(DemonstrationsError, match="there are no demonstrations"):
        concatenate([])


def test_to_device_and_pickle_keep_everything(ragged):
    assert ragged.to("cpu").equals(ragged)
    assert pickle.loads(pickle.dumps(ragged)).equals(ragged)


@pytest.mark.parametrize(
    "change",
    [
        lambda arguments: arguments["actions"][0, 0, 0].neg_().add_(1),  # the other action
        put(["truth", "reach"], (0,), 7),
        put(["truth", "bias"], (0,), 7),
        put(["setting"], None, "clear"),
        put(["provenance"], None, {}),
        put(["rewards"], None, None),
    ],
)
def test_equals_sees_each_difference(given_fields, ragged, change):
    assert Demonstrations(**given_fields).equals(ragged)
    change(given_fields)
    assert not Demonstrations(**given_fields).equals(ragged)

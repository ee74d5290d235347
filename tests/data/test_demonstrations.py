"""Recordings: what is kept, and what is made of them."""

import dataclasses
import pickle

import pytest
import torch
from example_recordings import NAN, RAGGED, fields, put

from mirror_ppl.data import Demonstrations, concatenate
from mirror_ppl.errors import DemonstrationsError, UnknownNameError


@pytest.fixture
def given_fields():
    return fields(RAGGED)


@pytest.fixture
def ragged(given_fields):
    return Demonstrations(**given_fields)


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

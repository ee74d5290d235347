"""Recordings that are refused, and values at the edge that are not."""

import math

import numpy as np
import pytest
import torch
from example_recordings import NAN, RAGGED, fields, put

from mirror_ppl.data import Demonstrations
from mirror_ppl.data.schema import A_NAME
from mirror_ppl.errors import DemonstrationsError, UnknownNameError


@pytest.fixture
def given_fields():
    return fields(RAGGED)


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
        "(person 3, round 3, time 5, ego_feature 1), as there are 4 actions a round",
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

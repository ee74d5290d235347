"""Items of a message that are not worth it by themselves are dropped."""

import pytest
import torch
from example_person import flags, plan

from mirror_ppl.communication import Valued
from mirror_ppl.communication.communicator import choose, slimmed
from mirror_ppl.communication.search import Found

FRONT, REAR, OTHER = flags(verbal=["front-left"]), flags(verbal=["rear-left"]), flags(["rear-left"])
DRAWS = 4


class Additive:
    """What items are worth now, ``[S]`` each, and what a plan gains if it says anything later."""

    def __init__(self, worth, later=0.0):
        self.worth = [(item, torch.as_tensor(value).expand(DRAWS)) for item, value in worth]
        self.later = later
        self.valued = 0

    def __call__(self, candidates):
        self.valued += len(candidates)
        utility = torch.zeros(len(candidates), DRAWS)
        for item, value in self.worth:
            utility += (candidates[:, 0] & item).any(-1)[:, None] * value
        return Valued(utility + self.later * candidates[:, 1:].flatten(1).any(1)[:, None], None)


def chosen_of(value, *candidates, min_standard_errors=2.0):
    """The plan that is left of the best of these."""
    candidates = torch.stack([plan(None, None), *candidates])
    found = Found(candidates, value(candidates))
    value.valued = 0
    found, index = slimmed(
        value, found, choose(found.valued, min_standard_errors), min_standard_errors
    )
    assert torch.equal(value(found.candidates).utility, found.valued.utility)
    return found.candidates[index]


def test_what_adds_nothing_now_is_not_said_though_the_plan_gains_much():
    value = Additive([(FRONT, -0.01)], later=5.0)
    assert torch.equal(chosen_of(value, plan(FRONT, REAR)), plan(None, REAR))


def test_what_adds_something_is_kept():
    value = Additive([(FRONT, 0.2), (REAR, 1.0)])
    assert torch.equal(chosen_of(value, plan(FRONT | REAR, None)), plan(FRONT | REAR, None))


def test_the_least_sure_item_goes_first_until_all_are_sure():
    value = Additive([(FRONT, -0.1), (REAR, -0.2), (OTHER, 1.0)])
    both = FRONT | REAR | OTHER
    assert torch.equal(chosen_of(value, plan(both, None)), plan(OTHER, None))
    # Three items were asked about, then two, then one, without which there is silence, whose value
    # is known; and seven plans by the check.
    assert value.valued == 3 + 2 + 0 + 7


@pytest.mark.parametrize(("min_standard_errors", "kept"), [(0.0, True), (1.5, True), (2.5, False)])
def test_an_item_has_to_be_worth_it_surely(min_standard_errors, kept):
    # One draw in four gains 1, at a cost of 0: the mean is 0.25, its standard error 0.25; with
    # 0.25 more for all, 0.5 and 0.25.
    value = Additive([(FRONT, [1.25, 0.25, 0.25, 0.25]), (REAR, 1.0)])
    left = chosen_of(value, plan(FRONT | REAR, None), min_standard_errors=min_standard_errors)
    assert torch.equal(left, plan(FRONT | REAR if kept else REAR, None))


def test_silence_is_left_alone():
    value = Additive([(FRONT, -1.0)])
    assert torch.equal(chosen_of(value, plan(FRONT, None)), plan(None, None))
    assert value.valued == 2  # those of the check

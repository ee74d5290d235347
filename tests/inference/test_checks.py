"""Posterior predictive checks against what is worked out by hand."""

import itertools
import math

import pytest
import torch

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.inference.results.checks import (
    CHECKS,
    REPLICATES,
    SHARE,
    Steps,
    p_values,
    steps_of,
)

PROBABILITIES = torch.tensor([[0.9, 0.1], [0.3, 0.7], [0.6, 0.4]])
REWARDS = torch.tensor([[0.0, -1.0], [-2.0, 0.5], [1.0, 1.0]])
ACTIONS = ("stay", "switch")


def steps(actions, draws=1):
    """Three steps, the last of a round of its own."""
    probabilities = PROBABILITIES.log().expand(draws, -1, -1)
    return Steps(torch.tensor(actions), probabilities, torch.tensor([-1, 0, -1]), REWARDS)


def by_hand(actions):
    """Values of all checks of a course of three actions, summed over the steps they are about."""
    first, second, third = actions
    return {
        "delayed": PROBABILITIES[0, second],
        "switches": float(first != second),  # of the recorded first one, see below
        "reward": sum(REWARDS[step, action] for step, action in enumerate(actions)),
        "surprise": -sum(PROBABILITIES[step, action].log() for step, action in enumerate(actions)),
        SHARE + "stay": float((first == 0) + (second == 0) + (third == 0)),
    }


@pytest.mark.parametrize("recorded", list(itertools.product([0, 1], repeat=3)))
def test_p_values_are_those_of_all_courses(recorded):
    """Estimated p-values are within four standard errors of those from all courses of actions."""
    found = p_values(steps(recorded), ACTIONS, torch.Generator().manual_seed(1))
    expected = dict.fromkeys(by_hand(recorded), 0.0)
    own = by_hand(recorded)
    for course in itertools.product([0, 1], repeat=3):
        weight = math.prod(float(PROBABILITIES[step, action]) for step, action in enumerate(course))
        # Steps follow the recorded ones, so that the second switches from the recorded first one.
        values = by_hand(course) | {"switches": float(course[1] != recorded[0])}
        for name, value in values.items():
            apart = float(value) - float(own[name])
            expected[name] += weight * (0.5 if abs(apart) < 1e-6 else float(apart > 0))
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert abs(found[name] - value) < 4 * 0.5 / REPLICATES**0.5, name


def test_of_more_than_two_actions_the_share_of_each_is_compared():
    probabilities = torch.full((1, 4, 3), 1 / 3).log()
    three = Steps(
        torch.tensor([0, 0, 0, 0]), probabilities, torch.tensor([-1, 0, 1, 2]), torch.zeros(4, 3)
    )
    found = p_values(three, ("a", "b", "c"), torch.Generator().manual_seed(1))
    assert [name for name in found if name.startswith(SHARE)] == [SHARE + name for name in "abc"]
    assert found[SHARE + "a"] < 0.05 and found[SHARE + "b"] > 0.5
    assert found["reward"] == 0.5  # nothing to compare: all ties


def test_without_steps_there_is_nothing_to_compare():
    none = Steps(
        *(part[:0] for part in (torch.zeros(1).long(),)),
        PROBABILITIES.log()[None, :0],
        torch.zeros(0).long(),
        REWARDS[:0],
    )
    assert p_values(none, ACTIONS, torch.Generator()) == {}
    alone = Steps(torch.tensor([0]), PROBABILITIES.log()[None, :1], torch.tensor([-1]), REWARDS[:1])
    found = p_values(alone, ACTIONS, torch.Generator().manual_seed(0))
    assert found.keys() == {"reward", "surprise", SHARE + "stay"}


def test_people_of_the_model_are_seldom_suspect():
    """Mid-p-values are at most as often extreme as uniform ones, but for what is discrete."""
    generator, extreme = torch.Generator().manual_seed(3), 0
    probabilities = torch.rand(2, 60, 2, generator=generator).log_softmax(-1)
    before = torch.arange(60) - 1
    number = 300
    for _ in range(number):
        # Of one of the two draws, as the person is.
        own = probabilities[int(torch.randint(2, (), generator=generator))]
        actions = torch.multinomial(own.exp(), 1, generator=generator)[:, 0]
        found = p_values(
            Steps(actions, probabilities, before, own), ACTIONS, torch.Generator().manual_seed(4)
        )
        extreme += sum(min(value, 1 - value) < 0.025 for value in found.values())
    checks = number * (len(CHECKS) + 1)
    # Those of a person depend on each other: as if there were a fifth of them.
    assert extreme / checks < 0.05 + 3 * (0.05 * 0.95 / number) ** 0.5


@pytest.mark.parametrize("world", ["driving_fog", "search_rescue_smoke", "bomb_defusal_unlabelled"])
def test_rewards_are_those_that_were_recorded(world):
    recordings = load_demonstrations(asset_path(f"{world}_paper.nc"))
    domain = get_domain(recordings.domain)
    one = recordings.select_people([0]).select_rounds(range(3))
    shape = (2, 1, *one.actions.shape[1:], len(domain.actions))
    found = steps_of(domain, one, torch.zeros(shape))
    real = one.mask[0]
    assert len(found.actions) == int(real.sum()) and found.log_probability.shape[:2] == (
        2,
        len(found.actions),
    )
    chosen = found.rewards.gather(-1, found.actions[:, None])[:, 0]
    torch.testing.assert_close(chosen, one.rewards[0][real].to(chosen))
    begins = [0, *one.lengths[0].cumsum(0).tolist()[:-1]]
    assert (found.before < 0).nonzero()[:, 0].tolist() == begins
    inside = found.before >= 0
    assert (found.before[inside] == torch.arange(len(inside))[inside] - 1).all()


def test_what_the_model_holds_impossible_is_surprising():
    sure = torch.tensor([[[0.5, 0.5], [1.0, 0.0]]]).log()
    impossible = Steps(torch.tensor([0, 1]), sure, torch.tensor([-1, 0]), REWARDS[:2])
    assert p_values(impossible, ACTIONS, torch.Generator().manual_seed(0))["surprise"] == 0

"""The exact planner against brute force, and as the yardstick of returns."""

import itertools
import math
import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from paths import DOCS

from mirror_ppl.domains.base import total_reward
from mirror_ppl.domains.driving import (
    SCENARIO_SPEEDS,
    Driving,
    DrivingState,
    known_car_values,
    lane_rewards,
    task_weights,
)
from mirror_ppl.domains.driving.lane_values import action_values

PAGE = DOCS / "driving.md"
DOMAIN = Driving()

small = st.integers(-9, 9)
tables = st.lists(st.tuples(small, small), min_size=1, max_size=6)
# Powers of two keep every sum exact in double precision.
discounts = st.sampled_from([1.0, 0.5, 0.25, 0.0])
lanes = st.sampled_from([0, 1])


def double(values):
    return torch.tensor(values, dtype=torch.float64)


def all_returns(rewards, lane, switch, discount):
    """Return of each of the 2**H sequences of actions, by its first action."""
    returns = {0: [], 1: []}
    for actions in itertools.product((0, 1), repeat=len(rewards)):
        now, total = lane, 0.0
        for step, action in enumerate(actions):
            now = 1 - now if action else now
            total += discount**step * (rewards[step][now] + switch * action)
        returns[actions[0]].append(total)
    return returns


def soft_values(rewards, lane, switch, discount, temperature):
    """The soft values as their definition says, one number at a time."""
    if not rewards:
        return [0.0, 0.0]
    values = []
    for action in (0, 1):
        reached = 1 - lane if action else lane
        ahead = 0.0
        if rewards[1:]:
            after = soft_values(rewards[1:], reached, switch, discount, temperature)
            top = max(after)
            ahead = top + temperature * math.log(
                sum(math.exp((v - top) / temperature) for v in after)
            )
        values.append(rewards[0][reached] + switch * action + discount * ahead)
    return values


# --- backward induction against brute force -----------------------------------------------------


@given(tables, lanes, small, discounts)
def test_values_are_those_of_the_best_sequence(rewards, lane, switch, discount):
    values = action_values(double(rewards), torch.tensor(lane), float(switch), discount)
    returns = all_returns(rewards, lane, switch, discount)
    assert values.tolist() == [max(returns[0]), max(returns[1])]


@given(tables, lanes, small, discounts, st.sampled_from([0.1, 1.0, 7.0]))
def test_soft_values_are_those_of_the_recursion(rewards, lane, switch, discount, temperature):
    values = action_values(
        double(rewards), torch.tensor(lane), float(switch), discount, temperature
    )
    expected = soft_values(rewards, lane, switch, discount, temperature)
    torch.testing.assert_close(values, double(expected), rtol=1e-12, atol=1e-10)


@given(tables, lanes, small, st.sampled_from([0.1, 1.0, 7.0]))
def test_undiscounted_soft_values_sum_over_all_sequences(rewards, lane, switch, temperature):
    values = action_values(double(rewards), torch.tensor(lane), float(switch), 1.0, temperature)
    returns = all_returns(rewards, lane, switch, 1.0)
    expected = [torch.logsumexp(double(returns[a]) / temperature, 0) * temperature for a in (0, 1)]
    torch.testing.assert_close(values, torch.stack(expected), rtol=1e-12, atol=1e-10)


@given(tables, lanes, small, discounts, st.sampled_from([1e-6, 0.1, 3.0]))
def test_soft_values_approach_the_optimal_ones(rewards, lane, switch, discount, temperature):
    arguments = double(rewards), torch.tensor(lane), float(switch), discount
    gap = action_values(*arguments, temperature) - action_values(*arguments)
    # Each later choice adds at most temperature * log 2, and discounts shrink the later ones.
    bound = temperature * math.log(2) * sum(discount**h for h in range(1, len(rewards)))
    assert gap.min() >= -1e-12
    assert gap.max() <= bound + 1e-12


def test_batches_with_a_number_of_their_own_for_each_round(generator):
    rewards = torch.randn(5, 4, 6, 2, generator=generator, dtype=torch.float64)
    lane = torch.randint(2, (5, 4), generator=generator)
    switch = torch.randn(5, 4, generator=generator, dtype=torch.float64)
    temperature = 0.1 + torch.rand(5, 4, generator=generator, dtype=torch.float64)
    hard = action_values(rewards, lane, switch, 0.9)
    soft = action_values(rewards, lane, switch, 0.9, temperature)
    assert hard.shape == soft.shape == (5, 4, 2)
    for i, j in itertools.product(range(5), range(4)):
        one = rewards[i, j], lane[i, j], switch[i, j].item(), 0.9
        torch.testing.assert_close(hard[i, j], action_values(*one))
        torch.testing.assert_close(soft[i, j], action_values(*one, temperature[i, j].item()))


# --- the planner in the domain ------------------------------------------------------------------


def play(policy, start):
    """Return ``[B]`` of a policy, a function of state and step, over a whole round."""
    now, returns = start, torch.zeros(start.lane.shape)
    for step in range(DOMAIN.horizon):
        action = policy(now, step)
        after = DOMAIN.transition(now, action)
        returns = returns + total_reward(DOMAIN.rewards(now, action, after))
        now = after
    return returns


def plan(now, step):
    return DOMAIN.reference_values(now, 1.0).argmax(-1)


def stay(now, step):
    return torch.zeros_like(now.lane)


def all_starts(speed):
    """Every start of a scenario, ``[2 * 11**4]``."""
    ahead = torch.arange(1, 12)
    position = torch.cartesian_prod(ahead, ahead, -ahead, -ahead).repeat(2, 1)
    lane = torch.arange(2).repeat_interleave(11**4)
    return DrivingState(lane, position, torch.tensor(speed).expand_as(position))


@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_reference_values_are_the_best_of_all_sequences_played_in_the_domain(discount, generator):
    sequences = torch.cartesian_prod(*[torch.arange(2)] * DOMAIN.horizon)  # [2**15, 15]
    for index in (2, 4, 7):
        start = DOMAIN.initial(1, generator, torch.tensor([index]))
        now, returns = start, torch.zeros(len(sequences))
        for step, action in enumerate(sequences.unbind(-1)):
            after = DOMAIN.transition(now, action)
            returns += discount**step * total_reward(DOMAIN.rewards(now, action, after))
            now = after
        best = torch.stack([returns[sequences[:, 0] == a].max() for a in (0, 1)])
        torch.testing.assert_close(DOMAIN.reference_values(start, discount)[0], best)


def test_looking_beyond_the_end_of_a_round_changes_nothing(generator):
    now = DOMAIN.initial(500, generator)
    known = torch.ones(500, 4).bool()
    for left in range(DOMAIN.horizon, 0, -1):
        ends = known_car_values(now, known, left, 1.0)
        assert torch.equal(DOMAIN.reference_values(now, 1.0), ends)
        now = DOMAIN.transition(now, torch.randint(2, (500,), generator=generator))


def test_unknown_cars_are_ignored(generator):
    now = DOMAIN.initial(500, generator)
    other = DOMAIN.initial(500, generator)
    known = torch.rand(500, 4, generator=generator) < 0.5
    mixed = DrivingState(
        now.lane,
        torch.where(known, now.position, other.position),
        torch.where(known, now.speed, other.speed),
    )
    values = known_car_values(now, known, 15, 0.95)
    assert torch.equal(values, known_car_values(mixed, known, 15, 0.95))
    # As for a person who received the known ones, and takes those to be all there are.
    told = {"visual": torch.zeros_like(known), "verbal": known}
    before = DOMAIN.nothing_known(500)
    knowledge = DOMAIN.learn(before, DOMAIN.observe(now), told, lambda expected: told)
    always = torch.ones(500).bool()
    supposed = DOMAIN.supposed(now, knowledge, {"clear": always, "closing": always})
    assert torch.equal(values, DOMAIN.reference_values(supposed, 0.95))
    assert not torch.equal(values, DOMAIN.reference_values(now, 0.95))
    nobody = known_car_values(now, torch.zeros_like(known), 15, 0.95)
    assert torch.equal(nobody, torch.tensor([0.0, -1.0]).expand(500, 2))


def test_lane_rewards_take_weights_by_distance():
    # Weights of 0, 1, 2, 3 cells; the second round has its own.
    weights = torch.tensor([[8.0, 4.0, 2.0, 1.0], [80.0, 40.0, 20.0, 10.0]])
    position = torch.tensor([[3, 5, -2, -9]]).expand(2, 4)
    speed = torch.tensor([[-1, -1, 1, 1]]).expand(2, 4)
    known = torch.tensor([[True, True, True, False]]).expand(2, 4)
    rewards = lane_rewards(position, speed, known, 3, weights)
    # Left: cars at 2 and -1, at 1 and 0, at 0 and 1 cells. Right: one at 4, 3, 2 cells.
    expected = torch.tensor([[2.0 + 4, 0], [4 + 8, 1], [8 + 4, 2]])
    assert torch.equal(rewards, torch.stack([expected, 10 * expected]))
    assert task_weights().tolist() == [-2 - 5, -2, -2]


# --- the yardstick ------------------------------------------------------------------------------


def test_no_policy_beats_the_planner_in_any_round(generator):
    start = DOMAIN.initial(2000, generator)
    best = play(plan, start)
    assert torch.equal(best, DOMAIN.reference_values(start, 1.0).max(-1).values)

    def chance(now, step):
        return torch.randint(2, now.lane.shape, generator=generator)

    def impatient(now, step):
        return DOMAIN.reference_values(now, 0.5).argmax(-1)

    def near_sighted(now, step):
        seen = DOMAIN.visibility("fog", DOMAIN.observe(now))["visual"]
        return known_car_values(now, seen, DOMAIN.horizon, 1.0).argmax(-1)

    for policy in (stay, chance, impatient, near_sighted):
        assert (play(policy, start) <= best).all()


def exact_means(speed):
    """Expected returns of a scenario: the planner's, of staying, of random actions."""
    start = all_starts(speed)
    best = DOMAIN.reference_values(start, 1.0).max(-1).values.double().mean().item()
    # Meeting a car that starts d cells away and closes in: five steps at up to two cells, one of
    # them in the same cell; the first ones are missing for d = 1 and 2. A car that drives away is
    # too near once, if it starts at one cell.
    meet = (9 * -15 - 13 - 11) / 11
    leave = -2 / 11
    closing = sum(v == side for v, side in zip(speed, (-1, -1, 1, 1), strict=True))
    staying = (closing * meet + (4 - closing) * leave) / 2
    # After a random action the lane is random, whatever it was; half the actions are switches.
    return best, staying, staying - 0.5 * DOMAIN.horizon


def test_expected_returns_are_those_of_the_documentation():
    rows = re.findall(
        r"^\| ([a-z, -]+?) +" + r"\| +(-\d+\.\d\d) +" * 3 + r"\|$", PAGE.read_text(), re.M
    )
    told = {name: tuple(map(float, numbers)) for name, *numbers in rows}
    means = {name: exact_means(speed) for name, speed in SCENARIO_SPEEDS.items()}
    means["mean"] = tuple(sum(column) / 8 for column in zip(*means.values(), strict=True))
    assert told.keys() == means.keys()
    for name, expected in means.items():
        assert told[name] == pytest.approx(expected, abs=0.005 + 1e-9), name


def test_planning_gains_over_staying_and_chance_what_arithmetic_says(generator):
    rounds = 4000
    start = DOMAIN.initial(rounds, generator)
    means = torch.tensor([exact_means(speed) for speed in SCENARIO_SPEEDS.values()]).mean(0)

    def chance(now, step):
        return torch.randint(2, now.lane.shape, generator=generator)

    best = play(plan, start)
    for policy, mean in ((stay, means[1]), (chance, means[2])):
        gain = best - play(policy, start)
        error = gain.std() / math.sqrt(rounds)
        # Five standard errors: two false alarms in two million seeds.
        assert abs(gain.mean() - (means[0] - mean)) < 5 * error
        assert gain.mean() - 5 * error > 5.0  # more than one collision a round

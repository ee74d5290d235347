"""What messages are worth: with improbable courses left to chance, the same on average."""

import pytest
import torch
from example_person import CHANNELS, DOMAIN, begun, flags, person, plan
from example_plans import HandSet

from mirror_ppl.communication import ExpectedUtility, PlanningContext, SimulatorWorld, every_message
from mirror_ppl.domains.base import total_reward


@pytest.mark.parametrize("branch", [0.1, 0.2, 0.4, 1.0])
def test_keeping_some_courses_by_chance_is_right_on_average(seed, branch):
    """Draws that are alike differ in their noise alone: their mean is within 4.5 standard errors.

    Of 20 comparisons one fails in about 7,000 seeds.
    """
    past = begun(0, [3, 5, -2, -3], [-1, -1, 1, 1])
    one, number = flags(verbal=["front-left"]), 3000
    candidates = torch.stack([plan(None), plan(one), plan(one | flags(verbal=["rear-right"]))])

    def value(number, branch, seed):
        someone = person(number, consistency=0.3, lapse=0.1)
        return ExpectedUtility(SimulatorWorld(DOMAIN), 4, 0.9, branch).at(
            PlanningContext.of(someone, past), 15, seed
        )

    exact, valued = value(1, 0, 0)(candidates), value(number, branch, seed)(candidates)
    gain, right = valued.utility - valued.utility[:1], exact.utility - exact.utility[:1]
    for sample, mean in ((valued.utility, exact.utility), (gain[1:], right[1:])):
        error = sample.std(-1) / number**0.5
        # Sums of thousands of rewards are rounded, where nothing is left to chance too.
        assert ((sample.mean(-1) - mean[:, 0]).abs() < 4.5 * error + 1e-4).all()
        assert (error > 1e-3).any()
    # A draw's weight on an action is from 0 to about 1: its variance is at most about a quarter.
    assert (valued.actions - exact.actions).abs().max() < 4.5 * 0.5 / number**0.5
    # The noise is the same for the same seed, and another for another.
    assert torch.equal(value(number, branch, seed)(candidates).utility, valued.utility)
    assert not torch.equal(value(number, branch, seed + 1)(candidates).utility, valued.utility)


def test_at_branch_one_each_draw_follows_a_single_course():
    """Only the third step is rewarded, by which of four courses led to it: a whole number."""
    rewards = [torch.zeros(1, 2), torch.zeros(1, 4), torch.arange(4.0).repeat_interleave(2)[None]]
    past = begun(0, [3, 5, -2, -3], [-1, -1, 1, 1])
    someone = person(200, consistency=0.3)
    value = ExpectedUtility(HandSet(rewards), 3, enumerate_above=1).at(
        PlanningContext.of(someone, past), 15, 0
    )
    followed = value(plan(None)[None]).utility[0]
    torch.testing.assert_close(followed, followed.round(), rtol=0, atol=1e-5)
    assert set(followed.round().long().tolist()) == {0, 1, 2, 3}


def test_what_could_be_gained_beyond_the_steps_looked_at_counts_if_asked_for():
    """``terminal_value`` adds the mean, 101.5, of what is to gain after the four courses."""
    rewards = [torch.zeros(1, 2), torch.zeros(1, 4)]
    past = begun(0, [3, 5, -2, -3], [-1, -1, 1, 1])
    someone = person(3, consistency=0.0)

    def worth(terminal_value, steps_left, discount=1.0, enumerate_above=0):
        objective = ExpectedUtility(HandSet(rewards), 2, discount, enumerate_above, terminal_value)
        value = objective.at(PlanningContext.of(someone, past), steps_left, 0)
        return value(torch.stack([plan(None), plan(flags(verbal=["front-left"]))])).utility

    cost = torch.tensor([[0.0], [0.03]])
    for discount in (1.0, 0.9):
        expected = discount**2 * 101.5 - cost
        torch.testing.assert_close(worth(True, 15, discount), expected.expand(2, 3))
    assert torch.equal(worth(False, 15), -cost.expand(2, 3))
    # At the end of the round there is nothing to gain after it.
    assert torch.equal(worth(True, 2), -cost.expand(2, 3))
    # A single course each, kept by chance: its last step is the mean of both actions.
    alone = worth(True, 15, enumerate_above=1)
    torch.testing.assert_close(alone + cost, (alone + cost).round(), rtol=0, atol=1e-4)
    assert set(alone[0].tolist()) <= {101, 102}


def test_what_is_kept_by_chance_is_small_however_much_is_to_gain():
    """Four courses end at 100 to 103, each with a weight of 0 or 0.8 for its 0.25."""
    rewards = [torch.zeros(1, 2), torch.zeros(1, 4)]
    past = begun(0, [3, 5, -2, -3], [-1, -1, 1, 1])
    objective = ExpectedUtility(HandSet(rewards), 2, enumerate_above=0.8, terminal_value=True)
    context = PlanningContext.of(person(2000, consistency=0.0), past)
    worth = objective.at(context, 15, 0)(plan(None)[None]).utility[0]
    assert abs(worth.mean() - 101.5) < 4.5 * worth.std() / len(worth) ** 0.5
    assert worth.std() > 0
    assert worth.min() > 99
    assert worth.max() < 104


def test_paths_are_worked_out_when_they_are_asked_for():
    past = begun(0, [3, 5, -2, -3], [-1, -1, 1, 1])
    rollouts = SimulatorWorld(DOMAIN).rollouts(past, 5, torch.Generator())
    path, action = torch.tensor([0, 0, 0]), torch.tensor([1, 0, 1])
    first = rollouts.follow(0, path, action)
    assert first.tolist() == [1, 0, 1]
    assert rollouts.names(1).tolist() == [0, 1]
    later = rollouts.follow(1, first, torch.tensor([1, 1, 1]))
    assert rollouts.names(2)[later].tolist() == [3, 1, 3]
    more = rollouts.follow(1, torch.tensor([1, 0]), torch.tensor([0, 1]))
    assert rollouts.names(2)[more].tolist() == [2, 1]
    # Those that were there already are the same as before.
    assert more[1] == later[1]
    # What is seen and gained on a path is what happens if its actions are taken.
    state = DOMAIN.state_behind(past.now)
    for step, done in enumerate((1, 0)):
        action = torch.tensor(done)
        following = DOMAIN.transition(state, action)
        here = [0, 1][step]
        reward = total_reward(DOMAIN.rewards(state, action, following))
        assert rollouts.rewards(step)[0, here, done] == reward
        state = following
    seen = DOMAIN.observe(state)
    for name, value in rollouts.observation(2).items():
        assert torch.equal(value[0, more[0]], seen[name])
    torch.testing.assert_close(
        rollouts.values(2)[0, more[0]], DOMAIN.reference_values(state, 1.0).amax(-1)
    )


@pytest.mark.parametrize("steps", [62, 80])
def test_long_paths_have_names_of_their_own(steps):
    """Also those of which there are more than whole numbers."""
    past = begun(0, [3, 5, -2, -3], [-1, -1, 1, 1])
    rollouts = SimulatorWorld(DOMAIN).rollouts(past, steps, torch.Generator())
    path, chooser = torch.zeros(64, dtype=torch.long), torch.Generator().manual_seed(0)
    for step in range(steps):
        path = rollouts.follow(step, path, torch.randint(2, path.shape, generator=chooser))
    assert len(rollouts.names(steps).unique()) == 64


def test_all_candidates_have_common_random_numbers():
    """To a person who does not listen all messages are worth the same, whatever was left to chance.

    So gains over silence have no spread at all: they are the costs.
    """
    past = begun(0, [3, 5, -2, -3], [-1, -1, 1, 1])
    someone = person(20, consistency=0.0)
    candidates = every_message(torch.ones(8, dtype=torch.bool))[:, None]
    value = ExpectedUtility(SimulatorWorld(DOMAIN), 4, enumerate_above=0.4).at(
        PlanningContext.of(someone, past), 15, 0
    )
    utility = value(candidates).utility
    assert utility[0].std() > 0.1
    gain = utility - utility[:1]
    cost = CHANNELS.cost(candidates[:, 0])
    torch.testing.assert_close(gain, -cost[:, None].expand_as(gain), rtol=0, atol=1e-4)

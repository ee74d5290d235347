"""Which action enters where: the one before, at every state."""

from dataclasses import replace

import pytest
import torch
from example_implants import ACTIONS, LATENT, STEPS
from example_networks import DRIVING, ITEMS
from pyro import poutine
from torch.distributions import Normal

from mirror_ppl.evaluation.self_model import fixed_views
from mirror_ppl.models.distributions import GaussianChain
from mirror_ppl.models.self_model import Rounds, SelfModel
from mirror_ppl.training.experience import Course, experience

CHANGED = 6
"""The step whose action is changed."""


@pytest.fixture
def courses(generator):
    """A self-model, actions of 5 rounds, and the same with the action of one step changed."""
    actions = torch.randint(ACTIONS, (5, STEPS), generator=generator)
    other = actions.clone()
    other[:, CHANGED] = 1 - other[:, CHANGED]
    return SelfModel(DRIVING), actions, other


def lived(actions):
    """Rounds of the same start, under the same clear view."""
    generator = torch.Generator().manual_seed(3)
    start = DRIVING.initial(len(actions), generator)
    return experience(
        DRIVING, Course.of(DRIVING, start, actions), fixed_views(DRIVING, len(actions), generator)
    )


def assert_first_difference(one, other, step, time=1):
    """The two agree up to a step, but not at it."""
    assert torch.equal(one.narrow(time, 0, step), other.narrow(time, 0, step))
    differs = (one.select(time, step) != other.select(time, step)).flatten(1).any(1)
    assert differs.all()


def test_encoder_reads_the_action_that_led_to_the_observation(courses):
    # The released code's transition read an action one step older than its encoder did.
    model, actions, other = courses
    rounds = lived(actions).rounds
    changed = replace(rounds, actions=other)  # the same observations

    def evidence(rounds):
        return model.evidence(rounds.observation, rounds.visible, rounds.actions)

    one, two = evidence(rounds), evidence(changed)
    assert_first_difference(one, two, CHANGED + 1)
    # It enters at that observation and no other.
    assert torch.equal(one[:, CHANGED + 2 :], two[:, CHANGED + 2 :])
    assert_first_difference(model.believe(one), model.believe(two), CHANGED + 1)


@pytest.mark.parametrize("program", ["model", "guide"])
def test_transition_and_guide_use_the_action_that_led_to_the_state(courses, program):
    model, actions, other = courses
    rounds = lived(actions).rounds

    def states(rounds: Rounds):
        torch.manual_seed(5)
        return poutine.trace(getattr(model, program)).get_trace(rounds).nodes["z"]["value"]

    assert_first_difference(states(rounds), states(replace(rounds, actions=other)), CHANGED + 1)


def test_transition_density_uses_the_action_that_led_to_the_state(courses):
    model, actions, other = courses
    z = torch.randn(5, STEPS + 1, LATENT)
    for chosen in (actions, other):
        chain = GaussianChain(model.prior(torch.Size([5])), model.transition, chosen, 0)
        by_hand = Normal(*model.transition(z[:, CHANGED], chosen[:, CHANGED]))
        step = chain.step(z[:, :-1], chosen)
        torch.testing.assert_close(step.mean[:, CHANGED], by_hand.mean)
        torch.testing.assert_close(step.scale[:, CHANGED], by_hand.scale)
    assert not torch.equal(
        model.transition(z[:, 0], actions[:, CHANGED]).mean,
        model.transition(z[:, 0], other[:, CHANGED]).mean,
    )


def test_reward_belongs_to_the_state_before_its_action(courses):
    model, actions, other = courses
    z = torch.randn(5, STEPS + 1, LATENT)

    def means(actions):
        rounds = replace(lived(actions).rounds, rewards=torch.zeros(5, STEPS))
        replayed = poutine.condition(model.model, data={"z": z})
        return poutine.trace(replayed).get_trace(rounds).nodes["reward"]["fn"].base_dist.loc

    one, two = means(actions), means(other)
    differs = (one != two).all(0)
    assert differs.tolist() == [step == CHANGED for step in range(STEPS)]
    expected = model.reward(z[:, CHANGED], actions[:, CHANGED]).mean
    torch.testing.assert_close(one[:, CHANGED], expected)


def test_experience_uses_the_same_indices(courses):
    _, actions, other = courses
    one, two = lived(actions), lived(other)
    for name in ("ego", "visual"):
        assert_first_difference(
            one.rounds.observation[name], two.rounds.observation[name], CHANGED + 1
        )
    rewards = one.rounds.rewards, two.rounds.rewards
    assert torch.equal(rewards[0][:, :CHANGED], rewards[1][:, :CHANGED])
    # Outcomes at a step are those of both actions at its state, whichever is taken there.
    for ours, theirs in zip(one.outcomes, two.outcomes, strict=True):
        assert_first_difference(ours.observation["ego"], theirs.observation["ego"], CHANGED + 1)
        assert torch.equal(ours.reward[:, : CHANGED + 1], theirs.reward[:, : CHANGED + 1])
    # The outcome of the action that is taken is what happens.
    for step in range(STEPS):
        for row in range(len(actions)):
            outcome = one.outcomes[actions[row, step]]
            assert outcome.reward[row, step] == one.rounds.rewards[row, step]
            for name, value in one.rounds.observation.items():
                assert torch.equal(outcome.observation[name][row, step], value[row, step + 1])
                if name in ITEMS:
                    seen = one.rounds.visible[name]
                    assert torch.equal(outcome.visible[name][row, step], seen[row, step + 1])

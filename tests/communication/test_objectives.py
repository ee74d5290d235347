"""What messages are worth: against a reference that goes through every course, and by hand."""

from dataclasses import dataclass, replace

import pytest
import torch
from example_course import beliefs_of, gone_through, perceived
from example_person import (
    CHANNELS,
    DOMAIN,
    Averaging,
    begun,
    flags,
    human,
    implants,
    person,
    plan,
    random_round,
    self_model,
    varied_draws,
)
from torch.distributions import Independent, Normal, kl_divergence

from mirror_ppl.communication import (
    Divergence,
    ExpectedUtility,
    Person,
    PlanningContext,
    RolloutTree,
    SelfModelWorld,
    SimulatorWorld,
    every_message,
)
from mirror_ppl.communication.objectives import ExpectedValue
from mirror_ppl.communication.planners import PlannerOptions, planner_of
from mirror_ppl.domains.base import total_reward
from mirror_ppl.domains.driving import CARS, DrivingState
from mirror_ppl.errors import HumanModelError, UnknownNameError
from mirror_ppl.models import HumanModel

ACTIONS = len(DOMAIN.actions)


# --- a reference without shortcuts ------------------------------------------------------------


class Simulated:
    """The world as it is, from a state ``[1]``."""

    def __init__(self, past, state):
        self.start = state

    def step(self, state, action):
        """The next state, what there is to observe in it, and the reward."""
        done = torch.tensor([action])
        following = DOMAIN.transition(state, done)
        reward = total_reward(DOMAIN.rewards(state, done, following))
        return following, DOMAIN.observe(following), float(reward)


class Learned:
    """The world as the self-model has learned it; states are means."""

    def __init__(self, past, state):
        self.start = robot(past).mean[None]

    def step(self, state, action):
        done = torch.tensor([action])
        following = self_model().transition(state, done).mean
        observation = DOMAIN.nearest(self_model().decode(following))
        return following, observation, float(self_model().reward(state, done).mean)


def robot(past):
    """What the robot believes, which sees everything: one step after the other."""
    model = self_model()
    embedded = model.encoder.embed(DOMAIN.symbols(past.observation))
    everything = embedded["ego"] + embedded["visual"].sum(-2) + embedded["verbal"].sum(-2)
    belief = torch.zeros(model.latent)
    for step, evidence in enumerate(everything):
        last = past.actions[step - 1] if step else torch.tensor(ACTIONS)
        state = model.encoder(belief, evidence + model.encoder.action(last))
        belief = state.mean
    return state


def probabilities(model, draw, past, told):
    """Probabilities of the next action of one draw, told this now: through the whole round."""
    now = past.then(CHANNELS.split(told), 0, past.now)  # the last observation is not used
    steps = past.time + 1
    observation = {name: value[None, :steps] for name, value in now.observation.items()}
    masks = {name: mask[None] for name, mask in now.told.items()}
    eyes = {name: value[0] for name, value in draw.items() if not value.is_floating_point()}
    belief = gone_through(model, eyes, observation, masks, now.actions[None])[:, -1:]
    return model.act(draw, belief, model.action_values(belief))[0, 0].exp().tolist()


@torch.no_grad()
def worth(model, draw, past, world, candidate, horizon, discount):
    """Utility of one candidate ``[L, N]`` for one draw, and probabilities of actions by step."""
    predicted = torch.zeros(horizon, ACTIONS)

    def rest(past, state, step, weight):
        if step == horizon:
            return 0.0
        told = candidate[step] if step < len(candidate) else torch.zeros(8, dtype=torch.bool)
        shown, said = int(told[:4].sum()), int(told[4:].sum())
        utility = -(0.01 * shown**2 + 0.03 * said**2)
        # What has left the road, or fallen behind, can no longer be told of, or shown.
        told = told & CHANNELS.join(DOMAIN.communicable(past.now))
        for action, chance in enumerate(probabilities(model, draw, past, told)):
            predicted[step, action] += weight * chance
            following, observation, reward = world.step(state, action)
            seen = {name: value[0] for name, value in observation.items()}
            later = past.then(CHANNELS.split(told), action, seen)
            onwards = rest(later, following, step + 1, weight * chance)
            utility += chance * (reward + discount * onwards)
        return utility

    return rest(past, world.start, 0, 1.0), predicted


def reference(someone, past, world, candidates, horizon, discount=1.0):
    """Utilities ``[C, S]`` and probabilities of actions ``[C, H, A]``."""
    utility = torch.zeros(len(candidates), someone.number)
    predicted = torch.zeros(len(candidates), horizon, ACTIONS)
    for s in range(someone.number):
        draw = {name: value[s] for name, value in someone.draws.items()}
        for c, candidate in enumerate(candidates):
            utility[c, s], mine = worth(
                someone.human, draw, past, world, candidate, horizon, discount
            )
            predicted[c] += mine / someone.number
    return utility, predicted


def candidates_of(past, generator, steps):
    """Silence, a message now, the same later, one after another, and something at every step."""
    allowed = CHANNELS.join(DOMAIN.communicable(past.now))
    some = allowed & (torch.rand(8, generator=generator) < 0.6)
    other = allowed & ~some
    noise = torch.rand(steps, 8, generator=generator) < 0.4
    return torch.stack(
        [
            plan(*[None] * steps),
            plan(allowed, *[None] * (steps - 1)),
            plan(*[None] * (steps - 1), allowed),
            plan(some, other, *[None] * (steps - 2)),
            allowed & noise,
        ]
    )


@dataclass(frozen=True)
class Named(DrivingState):
    """A state of the road that knows its path."""

    path: torch.Tensor


class HandSet:
    """The road as it is, with rewards set by hand: of each step ``[W, A**(h + 1)]``."""

    def __init__(self, rewards):
        self.rewards, self.draws = rewards, len(rewards[0])

    def rollouts(self, past, horizon, generator):
        now = {
            name: value[None, None].expand(self.draws, 1, *value.shape)
            for name, value in past.now.items()
        }
        path = torch.zeros(self.draws, 1, dtype=torch.long)
        state = Named(**vars(DOMAIN.state_behind(now)), path=path)
        return RolloutTree(self, state, now, ACTIONS, horizon)

    def observe(self, state):
        return DOMAIN.observe(state)

    def step(self, state, action, step):
        path = state.path * ACTIONS + action
        following = replace(DOMAIN.transition(state, action), path=path)
        return self.rewards[step].gather(1, path), following

    def value(self, state):
        return 100.0 + state.path.float()


@pytest.mark.parametrize(
    ("time", "horizon", "steps", "discount", "model", "world"),
    [
        (0, 4, 3, 1.0, HumanModel, SimulatorWorld),
        (3, 3, 2, 0.8, HumanModel, SimulatorWorld),
        (6, 4, 4, 0.9, HumanModel, SimulatorWorld),
        (2, 3, 2, 0.9, HumanModel, SelfModelWorld),
        (2, 3, 3, 1.0, Averaging, SimulatorWorld),
    ],
)
def test_utilities_are_those_of_every_course(
    generator, time, horizon, steps, discount, model, world
):
    past, state = random_round(time, generator)
    model = model(self_model())
    someone = Person(model, varied_draws(3, generator, model))
    # The last is to show everything at each step, as far as it can be shown.
    everything = flags(visual=CARS).expand(1, steps, -1)
    candidates = torch.cat([candidates_of(past, generator, steps), everything])
    if world is SimulatorWorld:
        real, own = Simulated(past, state), SimulatorWorld(DOMAIN)
    else:
        real, own = Learned(past, state), SelfModelWorld(self_model())
    expected, predicted = reference(someone, past, real, candidates, horizon, discount)
    value = ExpectedUtility(own, horizon, discount, enumerate_above=0).at(
        PlanningContext.of(someone, past), 15 - time, 0
    )
    valued = value(candidates)
    torch.testing.assert_close(valued.utility, expected, rtol=0, atol=1e-4)
    torch.testing.assert_close(valued.actions, predicted, rtol=0, atol=1e-4)
    # Where all is still to tell, messages change what is done.
    assert time > 0 or (predicted - predicted[:1]).abs().max() > 0.01
    # A candidate's value does not depend on which others are valued along with it.
    for c, candidate in enumerate(candidates):
        alone = value(candidate[None])
        torch.testing.assert_close(alone.utility[0], expected[c], rtol=0, atol=1e-4)
        torch.testing.assert_close(alone.actions[0], predicted[c], rtol=0, atol=1e-4)


@pytest.mark.parametrize(("clear", "closing"), [(0, 0), (0, 1), (1, 0), (1, 1)])
@pytest.mark.parametrize(
    ("name", "car", "places"),
    [
        ("visual", "front-left", [11, 12]),  # as far as can be shown
        ("verbal", "front-left", [11, 12]),
        ("visual", "rear-right", [0, -1]),  # only what is ahead can be shown
        ("verbal", "rear-right", [-11, -12]),
    ],
)
def test_items_that_cannot_be_communicated_at_their_step_change_only_the_cost(
    clear, closing, name, car, places
):
    """The same message a step earlier does, but where everybody sees the car; and so do others."""
    positions, speeds, index = [3, 5, -3, -3], [-1, -1, 1, 1], CARS.index(car)
    positions[index], speeds[index] = places[0], places[1] - places[0]
    past = begun(0, positions, speeds)
    someone = person(3, front_own=[0, 2, 4], assumes_clear=clear, assumes_closing=closing)
    told, other = flags(**{name: [car]}), flags(verbal=["rear-left"])
    value = ExpectedUtility(SimulatorWorld(DOMAIN), 3, 0.9, enumerate_above=0).at(
        PlanningContext.of(someone, past), 15, 0
    )
    candidates = [plan(None, None), plan(None, told), plan(told, None), plan(None, told | other)]
    valued = value(torch.stack([*candidates, plan(None, other)]))
    costs = CHANNELS.cost(torch.stack([told, told | other, other])) * 0.9
    silence, late, early, both, alone = valued.utility
    torch.testing.assert_close(late, silence - costs[0], rtol=0, atol=1e-5)
    torch.testing.assert_close(both + costs[1], alone + costs[2], rtol=0, atol=1e-5)
    assert torch.equal(valued.actions[1], valued.actions[0])
    assert torch.equal(valued.actions[3], valued.actions[4])
    gain = (early - silence + costs[0] / 0.9).abs()
    assert gain.max() > 1e-3 if places[0] else gain.max() < 1e-5
    assert (both - late).abs().max() > 0.05


def test_silence_after_a_message_is_the_message_alone(generator):
    past, _ = random_round(2, generator)
    someone = Person(human(), varied_draws(4, generator))
    value = ExpectedUtility(SimulatorWorld(DOMAIN), 4).at(PlanningContext.of(someone, past), 13, 0)
    told = flags(visual=["front-left"], verbal=["rear-right"])
    short, long = value(plan(told)[None]), value(plan(told, None, None)[None])
    torch.testing.assert_close(short.utility, long.utility)


# --- improbable courses -----------------------------------------------------------------------


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
    """Of courses that end at path 0 to 3 with 100 more than that to gain: the mean of all."""
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


def test_more_steps_than_can_be_named_are_refused():
    past = begun(0, [3, 5, -2, -3], [-1, -1, 1, 1])
    with pytest.raises(ValueError, match="of 2 actions at most 62 steps can be looked ahead"):
        SimulatorWorld(DOMAIN).rollouts(past, 63, torch.Generator())


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


# --- horizon, discount, costs -----------------------------------------------------------------


def test_steps_after_the_end_of_the_round_do_not_count(generator):
    past, _ = random_round(4, generator)
    someone = Person(human(), varied_draws(4, generator))
    candidates = candidates_of(past, generator, 4)
    world = SimulatorWorld(DOMAIN)
    cut = ExpectedUtility(world, 6, 0.9, 0).at(PlanningContext.of(someone, past), 2, 0)(candidates)
    short = ExpectedUtility(world, 2, 0.9, 0).at(PlanningContext.of(someone, past), 11, 0)(
        candidates
    )
    longer = ExpectedUtility(world, 3, 0.9, 0).at(PlanningContext.of(someone, past), 11, 0)(
        candidates
    )
    assert cut.actions.shape == (5, 2, ACTIONS)
    torch.testing.assert_close(cut.utility, short.utility)
    torch.testing.assert_close(cut.actions, short.actions)
    assert (cut.utility - longer.utility).abs().max() > 0.1
    # What would be said only then neither helps nor costs.
    torch.testing.assert_close(cut.utility[2], cut.utility[0])


@pytest.mark.parametrize("discount", [1.0, 0.5])
def test_messages_are_charged_at_the_step_at_which_they_are_sent(discount):
    past = begun(0, [30, 30, -30, -30], [1, 1, -1, -1])
    someone = person(2, consistency=0.0)
    two = flags(visual=["front-left", "front-right"])
    three = flags(verbal=["front-left", "rear-left", "rear-right"])
    silence = plan(None, None, None)
    candidates = torch.stack([silence, plan(two, None, None), plan(None, two, three)])
    value = ExpectedUtility(SimulatorWorld(DOMAIN), 5, discount).at(
        PlanningContext.of(someone, past), 15, 0
    )
    gain = value(candidates).utility - value(candidates).utility[:1]
    expected = torch.tensor([0, -0.04, -(0.04 * discount + 0.27 * discount**2)])
    torch.testing.assert_close(gain, expected[:, None].expand(3, 2), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("discount", "total"), [(1.0, 4.0), (0.5, 1.875)])
def test_rewards_are_discounted_by_step(discount, total):
    past = begun(0, [30, 30, -30, -30], [1, 1, -1, -1])
    world = HandSet([torch.ones(1, ACTIONS ** (h + 1)) for h in range(4)])
    value = ExpectedUtility(world, 4, discount, enumerate_above=0).at(
        PlanningContext.of(person(), past), 15, 0
    )
    assert value(plan(None)[None]).utility.item() == pytest.approx(total, abs=1e-5)


def test_draws_are_dealt_out_over_draws_of_the_world():
    past = begun(0, [30, 30, -30, -30], [1, 1, -1, -1])
    own = torch.tensor([1.0, 10.0, 100.0])[:, None]
    world = HandSet([own.expand(3, ACTIONS ** (h + 1)) for h in range(2)])
    value = ExpectedUtility(world, 2, enumerate_above=0).at(
        PlanningContext.of(person(7), past), 15, 0
    )
    expected = torch.tensor([[2.0, 20, 200, 2, 20, 200, 2]])
    torch.testing.assert_close(value(plan(None)[None]).utility, expected)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 0}, "horizon must be at least 1, not 0"),
        ({"discount": 0.0}, "discount must be above 0 and at most 1, not 0.0"),
        ({"discount": 1.1}, "discount must be above 0 and at most 1, not 1.1"),
        ({"enumerate_above": -0.1}, "enumerate_above must be from 0 to 1, not -0.1"),
        ({"enumerate_above": 1.5}, "enumerate_above must be from 0 to 1, not 1.5"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError) as error:
        ExpectedUtility(SimulatorWorld(DOMAIN), **options)
    assert str(error.value) == message


def test_a_world_has_at_least_one_draw():
    with pytest.raises(ValueError, match="draws must be at least 1, not 0"):
        SelfModelWorld(self_model(), 0)


# --- divergence -------------------------------------------------------------------------------


def told_belief(draw, past, told):
    """``q(zH_t | told)`` of one draw: the belief before, and a step from it."""
    eyes = {name: value[0] for name, value in draw.items() if not value.is_floating_point()}
    now = past.then(CHANNELS.split(told), 0, past.now)
    observation = {name: value[None, :-1] for name, value in now.observation.items()}
    view = perceived(human(), eyes, observation, {n: mask[None] for n, mask in now.told.items()})
    evidence = human().evidence(view, observation)[0, -1]
    before, last = torch.zeros(self_model().latent), torch.tensor(ACTIONS)
    if past.time:
        before = beliefs_of(human(), view, observation, now.actions[None])[0, -2]
        last = past.actions[-1]
    return human().believe(before, evidence, last)


@torch.no_grad()
@pytest.mark.parametrize("time", [0, 1, 4])
@pytest.mark.parametrize(("measure", "weight"), [("kl", 1.0), ("kl", 2.5), ("squared", 0.5)])
def test_divergence_is_that_of_two_gaussians(generator, time, measure, weight):
    past, _ = random_round(time, generator)
    someone = Person(human(), varied_draws(4, generator))
    candidates = candidates_of(past, generator, 2)
    valued = Divergence(weight, measure).at(PlanningContext.of(someone, past), 5, 0)(candidates)
    assert valued.actions is None
    mine = robot(past)
    for c, candidate in enumerate(candidates):
        for s in range(4):
            draw = {name: value[s] for name, value in someone.draws.items()}
            theirs = told_belief(draw, past, candidate[0])
            if measure == "kl":
                apart = kl_divergence(*(Independent(Normal(*q), 1) for q in (mine, theirs)))
            else:
                apart = (mine.mean - theirs.mean).pow(2).sum()
            expected = -weight * apart - CHANNELS.cost(candidate[0])
            torch.testing.assert_close(valued.utility[c, s], expected, rtol=1e-4, atol=1e-4)
    # Where all is still to tell, more than costs is at stake.
    apart = valued.utility + CHANNELS.cost(candidates[:, 0])[:, None]
    assert time > 0 or apart.std(0).max() > 0.1


@torch.no_grad()
@pytest.mark.parametrize("time", [0, 3])
def test_expected_values_are_those_of_the_next_action(generator, time):
    """Of each draw: probabilities of actions after the message, times the robot's values."""
    past, _ = random_round(time, generator)
    someone = Person(human(), varied_draws(4, generator))
    candidates = candidates_of(past, generator, 2)
    valued = ExpectedValue().at(PlanningContext.of(someone, past), 5, 0)(candidates)
    values = self_model().action_values(robot(past).mean)
    assert valued.actions is not None and valued.actions.shape == (len(candidates), 1, ACTIONS)
    for c, candidate in enumerate(candidates):
        found = []
        for s in range(4):
            draw = {name: value[s, None] for name, value in someone.draws.items()}
            belief = told_belief({n: v[0] for n, v in draw.items()}, past, candidate[0]).mean
            own = human().action_values(belief)
            found.append(Person(human(), draw).act(belief[None, None], own[None, None]).exp())
            expected = (found[-1][0, 0] * values).sum() - CHANNELS.cost(candidate[0])
            torch.testing.assert_close(valued.utility[c, s], expected, rtol=1e-4, atol=1e-4)
        mean = torch.cat(found).mean(0)
        torch.testing.assert_close(valued.actions[c], mean, rtol=1e-4, atol=1e-5)


def test_what_mirror_predicts_with_is_chosen_by_name():
    kinds = {
        name: type(planner_of("mirror", person(), PlannerOptions(predict_with=name), 0).objective)
        for name in ("simulator", "self-model", "values")
    }
    assert list(kinds.values()) == [ExpectedUtility, ExpectedUtility, ExpectedValue]
    with pytest.raises(UnknownNameError, match="self-model, simulator, values"):
        PlannerOptions(predict_with="luck")


def test_models_without_a_density_are_refused(generator):
    past, _ = random_round(1, generator)
    model = Averaging(self_model())
    with pytest.raises(HumanModelError) as error:
        Divergence().at(PlanningContext.of(Person(model, implants(2, model)), past), 5, 0)
    assert str(error.value) == (
        "beliefs of Averaging have no density like the robot's, which mirror-kl compares: its "
        "believe returns no Gaussian, or one of another size"
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"measure": "js"}, 'measure must be kl or squared, not "js"'),
        ({"weight": 0.0}, "weight must be positive, not 0.0"),
        ({"weight": -1.0}, "weight must be positive, not -1.0"),
        ({"weight": float("nan")}, "weight must be positive, not nan"),
    ],
)
def test_impossible_measures_are_refused(options, message):
    with pytest.raises(ValueError) as error:
        Divergence(**options)
    assert str(error.value) == message

"""What messages are worth: against a reference that goes through every course, and by hand."""

import pytest
import torch
from example_course import gone_through
from example_person import (
    CHANNELS,
    DOMAIN,
    Averaging,
    begun,
    flags,
    human,
    person,
    plan,
    random_round,
    self_model,
    varied_draws,
)
from example_plans import ACTIONS, HandSet, candidates_of, robot

from mirror_ppl.communication import (
    ExpectedUtility,
    Person,
    PlanningContext,
    SelfModelWorld,
    SimulatorWorld,
)
from mirror_ppl.domains.base import total_reward
from mirror_ppl.domains.driving import CARS
from mirror_ppl.models import HumanModel

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


@pytest.mark.parametrize(
    ("time", "horizon", "steps", "discount", "model", "world"),
    [
        (0, 4, 3, 1.0, HumanModel, SimulatorWorld),
        (3, 3, 2, 0.8, HumanModel, SimulatorWorld),
        (6, 3, 3, 0.9, HumanModel, SimulatorWorld),
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
    """Late, an item changes the cost alone; a step earlier it has value, unless all see the car."""
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

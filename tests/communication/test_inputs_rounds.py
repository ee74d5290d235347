"""Rounds from Python: arrays of any kind are taken, others refused in a line."""

import numpy as np
import pytest
import torch
from example_inputs import KINDS, NAN, NOW, WORLD, going_on
from example_person import CHANNELS, DOMAIN, flags, human, implants, random_round
from refused import refused

from mirror_ppl.communication import Communicator, ExpectedUtility, Person, RoundSoFar
from mirror_ppl.domains import get_domain

NOTHING = CHANNELS.split(flags())


@pytest.fixture
def someone():
    return Person(human(), implants(3, sight=2))


@pytest.fixture
def communicator(someone):
    return Communicator(someone, ExpectedUtility(WORLD, 2))


def same(one, other):
    for name, value in other.observation.items():
        assert torch.equal(one.observation[name], value)
        assert one.observation[name].dtype == torch.get_default_dtype()
    for name, value in other.told.items():
        assert torch.equal(one.told[name], value)
    assert torch.equal(one.actions, other.actions)


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())
def test_rounds_of_any_kind_are_the_same_round(kind, generator, communicator):
    past, state = random_round(2, generator)
    every = {name: kind(value) for name, value in past.observation.items()}
    told = {name: kind(value) for name, value in past.told.items()}
    made = RoundSoFar(every, kind(past.actions), told)
    same(made, past)

    grown = RoundSoFar.begin(DOMAIN, {name: value[0] for name, value in every.items()})
    for step in range(2):
        grown = grown.then(
            {name: value[step] for name, value in told.items()},
            kind(past.actions)[step],
            {name: value[step + 1] for name, value in every.items()},
        )
    same(grown, past)
    decision, expected = communicator.plan(made), communicator.plan(past)
    assert torch.equal(decision.flags, expected.flags) and decision.gain == expected.gain


@pytest.mark.parametrize("action", [1, np.int64(1), np.uint8(1), torch.tensor([1]), 1.0, [1]])
def test_an_action_may_be_any_whole_number(action):
    past = going_on(0).then(NOTHING, action, NOW)
    assert past.actions.tolist() == [1] and past.actions.dtype == torch.long


FIRST = {
    "no ego": ({"visual": 0, "verbal": 0}, "has visual, verbal, expected ego, visual, verbal"),
    "too much": (NOW | {"smell": NOW["ego"]}, "verbal, smell, expected ego, visual, verbal"),
    "no dict": (NOW["visual"], "must be a dict with ego, visual, verbal, not Tensor of shape (4,"),
    "text": (NOW | {"ego": "left"}, "the observation of \"ego\" is 'left', expected an array of"),
    "a batch": (NOW | {"ego": NOW["ego"][None]}, '"ego" has shape (1, 1), expected (1,)'),
    "nan": (NOW | {"visual": NOW["visual"] * NAN}, '"visual" has nan, expected finite numbers'),
    "elsewhere": (NOW | {"ego": [5]}, "time 0: this observation cannot be: ego lane has to be 0"),
}


@pytest.mark.parametrize(("observation", "message"), FIRST.values(), ids=FIRST.keys())
def test_wrong_first_observations_are_refused(observation, message):
    refused(lambda: RoundSoFar.begin(DOMAIN, observation), message)


def test_the_domain_of_a_round_is_a_domain():
    refused(lambda: RoundSoFar.begin("driving", NOW), "must be a domain, with the method observe")


NEXT = {
    "half an action": ({"action": 1.7}, "the action has 1.7, expected whole numbers"),
    "no number": ({"action": NAN}, "the action has nan, expected whole numbers"),
    "true": ({"action": True}, "the action has True or False, expected whole numbers"),
    "a name": ({"action": "stay"}, "the action is 'stay', expected an array of numbers"),
    "no action": ({"action": None}, "the action is None, expected an array of numbers"),
    "two actions": ({"action": [0, 1]}, "the action has shape (2,), expected one number"),
    "told what": ({"told": NOTHING | {"verbal": [0, 0, 2, 0]}}, '"verbal" has 2, expected True or'),
    "half told": ({"told": NOTHING | {"verbal": [0, 0.5, 0, 0]}}, "has 0.5, expected True or"),
    "told too little": ({"told": {"visual": [0] * 4}}, "told has visual, expected visual, verbal"),
    "told too much": ({"told": NOTHING | {"smell": [0]}}, "verbal, smell, expected visual, verbal"),
    "told two": ({"told": NOTHING | {"visual": [0, 0]}}, '"visual" has shape (2,), expected (4,)'),
    "told flags": ({"told": flags()}, "told must be a dict with visual, verbal, not Tensor of"),
    "less to see": ({"observation": {"ego": [0]}}, "has ego, expected ego, visual, verbal"),
    "more to see": ({"observation": NOW | {"smell": [0]}}, "verbal, smell, expected ego, visual"),
    "one car": ({"observation": NOW | {"visual": [[1, 0]]}}, "has shape (1, 2), expected (4, 2)"),
}


@pytest.mark.parametrize(("change", "message"), NEXT.values(), ids=NEXT.keys())
def test_wrong_next_steps_are_refused(change, message):
    given = {"told": NOTHING, "action": 0, "observation": NOW} | change
    refused(lambda: going_on(1).then(**given), message)


def with_one(value, index, new):
    value = value.clone()
    value[index] = new
    return value


WHOLE = {
    "an action 7 of 2": (
        {"actions": [7, 0, 0]},
        "step 0: there is no action 7; actions count from",
    ),
    "an action -1": (
        {"actions": [0, -1, 0]},
        "step 1: there is no action -1; actions count from 0",
    ),
    "half an action": ({"actions": [0, 0.5, 0]}, "actions has 0.5, expected whole numbers"),
    "actions in two dimensions": (
        {"actions": [[0], [0], [0]]},
        "actions has shape (3, 1), expected",
    ),
    "an action alone": (
        {"actions": torch.tensor(0)},
        "actions has shape (), expected one dimension",
    ),
    "true": (
        {"actions": torch.ones(3).bool()},
        "actions has True or False, expected whole numbers",
    ),
    "told nothing": ({"told": {}}, "told has nothing, expected visual, verbal"),
    "told text": ({"told": "silence"}, "told must be a dict with visual, verbal, not 'silence'"),
    "told of two cars": (
        {"told": {"visual": [[0, 0]] * 3, "verbal": [[0] * 4] * 3}},
        "(3, 2), exp",
    ),
    "told a number": ({"told": {"visual": 0, "verbal": 0}}, "has shape (), expected (3, 4)"),
    "told thrice": (
        {"told": {"visual": [[3] * 4] * 3, "verbal": [[0] * 4] * 3}},
        "has 3, expected",
    ),
    "no ego": (
        {"observation": {"visual": torch.zeros(4, 4, 2)}},
        'a dict with "ego" and modalities',
    ),
    "a number": ({"observation": 3}, 'must be a dict with "ego" and modalities, not 3'),
    "flat": ({"observation": {"ego": torch.zeros(4)}}, "shape (4,), expected (t + 1, E)"),
}


@pytest.mark.parametrize(("change", "message"), WHOLE.values(), ids=WHOLE.keys())
def test_wrong_rounds_are_refused(communicator, change, message):
    past = going_on(3)
    given = {"observation": past.observation, "actions": past.actions, "told": past.told} | change
    refused(lambda: communicator.plan(RoundSoFar(**given)), message)


EARLIER = {
    "nan": (
        "visual",
        (0, 1, 0),
        NAN,
        'time 0: the observation of "visual" has nan, expected finite',
    ),
    "infinite": ("verbal", (2, 1, 2), float("inf"), 'time 2: the observation of "verbal" has inf'),
    "elsewhere": (
        "ego",
        (1, 0),
        5,
        "time 1: this observation cannot be: ego lane has to be 0 or 1",
    ),
    "too fast": (
        "verbal",
        (0, 0, 2),
        5,
        "time 0: this observation cannot be: relative_speed has to",
    ),
}


@pytest.mark.parametrize(("name", "index", "new", "message"), EARLIER.values(), ids=EARLIER.keys())
def test_wrong_earlier_steps_are_refused(communicator, name, index, new, message):
    past = going_on(3)
    every = past.observation | {name: with_one(past.observation[name], index, new)}
    refused(lambda: communicator.plan(RoundSoFar(every, past.actions, past.told)), message)


@pytest.mark.parametrize("name", ["search_rescue", "bomb_defusal"])
def test_pixels_have_to_be_numbers(name, generator):
    """A comparison with what can be seen says nothing against nan."""
    domain = get_domain(name)
    now = {key: value[0] for key, value in domain.observe(domain.initial(1, generator)).items()}
    RoundSoFar.begin(domain, now)
    now["visual"][0, 0] = NAN
    refused(lambda: RoundSoFar.begin(domain, now), "has nan, expected finite numbers")


def test_rounds_of_another_domain_are_refused(communicator, generator):
    domain = get_domain("bomb_defusal")
    now = {name: value[0] for name, value in domain.observe(domain.initial(1, generator)).items()}
    past = RoundSoFar.begin(domain, now)
    refused(lambda: communicator.plan(past), '"ego" has shape (1, 2), expected (1, 1)')


def test_after_the_last_step_there_is_silence_and_beyond_it_no_plan(communicator):
    assert communicator.plan(going_on(DOMAIN.horizon - 1)).over is False
    decision = communicator.plan(going_on(DOMAIN.horizon))
    assert decision.over and not decision.message
    beyond = going_on(DOMAIN.horizon + 1)
    refused(lambda: communicator.plan(beyond), "the round has 16 steps, expected at most 15")


def test_what_is_over_stays_over(generator):
    """In bomb defusal all is done after the third button; recordings may go on after it."""
    domain = get_domain("bomb_defusal")
    before = {
        name: value[0] for name, value in domain.observe(domain.initial(1, generator)).items()
    }
    state = domain.state_behind({name: value[None] for name, value in before.items()})
    while not domain.over(state):
        state = domain.transition(state, domain.reference_values(state, 1.0).argmax(-1))
    done = observed_in(domain, state)
    nothing = {m.name: [False] * len(m.items) for m in domain.modalities}
    over = RoundSoFar.begin(domain, before).then(nothing, 0, done)
    over.check(domain)
    over.then(nothing, 3, done).check(domain)  # they press a button more
    again = over.then(nothing, 0, before)
    refused(lambda: again.check(domain), "the round was over at time 1, but goes on at time 2")


def observed_in(domain, state):
    return {name: value[0] for name, value in domain.observe(state).items()}


@pytest.mark.parametrize("past", [None, NOW])
def test_a_plan_needs_a_round(communicator, past):
    refused(lambda: communicator.plan(past), "the round so far must be of the class RoundSoFar, no")

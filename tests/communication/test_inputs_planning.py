"""Planning from Python: rounds, draws and arguments of any kind are taken, or refused in a line."""

import numpy as np
import pytest
import torch
from example_person import CHANNELS, DOMAIN, begun, flags, human, implants, random_round
from refused import refused

from mirror_ppl.communication import (
    Communicator,
    ExpectedUtility,
    Person,
    RoundSoFar,
    SelfModelWorld,
    SimulatorWorld,
)
from mirror_ppl.domains import get_domain

NAN = float("nan")
NOW = begun(0, [3, 9, -9, -8], [-1, 1, -1, -1]).now
NOTHING = CHANNELS.split(flags())
WORLD = SimulatorWorld(DOMAIN)


@pytest.fixture
def someone():
    return Person(human(), implants(3, sight=2))


@pytest.fixture
def communicator(someone):
    return Communicator(someone, ExpectedUtility(WORLD, 2))


def going_on(steps, domain=DOMAIN, now=NOW):
    """A round in which nothing happens."""
    told = {m.name: [0] * len(m.items) for m in domain.modalities}
    past = RoundSoFar.begin(domain, now)
    for _ in range(steps):
        past = past.then(told, 0, now)
    return past


def same(one, other):
    for name, value in other.observation.items():
        assert torch.equal(one.observation[name], value)
        assert one.observation[name].dtype == torch.get_default_dtype()
    for name, value in other.told.items():
        assert torch.equal(one.told[name], value)
    assert torch.equal(one.actions, other.actions)


# --- rounds ------------------------------------------------------------------------------------

KINDS = {
    "float64": lambda value: value.double(),
    "numpy": lambda value: value.numpy(),
    "numpy of float64": lambda value: value.numpy().astype(np.float64),
    "numpy of int64": lambda value: value.numpy().astype(np.int64),
    "lists": lambda value: value.tolist(),
}


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


# --- the end of a round ------------------------------------------------------------------------


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


# --- people ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in KINDS if name != "numpy of int64"])
def test_draws_of_any_kind_are_the_same_person(name, someone):
    kind = KINDS[name]
    draws = {name: kind(value) for name, value in someone.draws.items()}
    same_one = Person(human(), draws)
    assert {name: value.dtype for name, value in same_one.draws.items()} == {
        name: value.dtype for name, value in someone.draws.items()
    }
    utility = ExpectedUtility(WORLD, 2)
    plans = [Communicator(one, utility).plan(going_on(1)) for one in (someone, same_one)]
    assert plans[0].gain == plans[1].gain and torch.equal(plans[0].flags, plans[1].flags)


def changed(site, change):
    return lambda draws: draws | {site: change(draws[site])}


PEOPLE = {
    "several people": (
        lambda draws: {name: torch.cat([value, value], 1) for name, value in draws.items()},
        'draws of "sight_front_own" are of 2 people, expected 1',
    ),
    "no people": (
        lambda draws: {name: value[:, 0, 0] for name, value in draws.items()},
        'draws of "sight_front_own" have shape (3,), expected (3, 1, 1)',
    ),
    "fewer draws of a site": (
        changed("lapse", lambda value: value[:2]),
        'draws of "lapse" have shape (2, 1, 1), expected (3, 1, 1)',
    ),
    "a smaller residual": (
        changed("residual_in", lambda value: value[..., :2]),
        'draws of "residual_in" have shape (3, 1, 1, 49, 2), expected (3, 1, 1, 49, 8)',
    ),
    "nan": (changed("lapse", lambda value: value * NAN), '"lapse" have nan, expected only what'),
    "infinite": (
        changed("residual_out", lambda value: value + torch.inf),
        "inf, expected only",
    ),
    "a lapse above 1": (changed("lapse", lambda value: value + 2), "have 2.02, expected only what"),
    "sight beyond": (changed("sight_back_own", lambda value: value + 9), "have 11, expected only"),
    "half a bin": (changed("sight_back_own", lambda value: value + 0.5), "2.5, expected whole"),
    "text": (changed("lapse", lambda value: "rarely"), "\"lapse\" is 'rarely', expected an array"),
    "a site too few": (
        lambda draws: {name: value for name, value in draws.items() if name != "lapse"},
        "there are no draws of the site lapse",
    ),
    "a site too many": (lambda draws: draws | {"x\n": draws["lapse"]}, r"draws of 'x\n', expected"),
    "no dict": (lambda draws: draws["lapse"], "draws must be a dict of arrays by site, not Tensor"),
}


@pytest.mark.parametrize(("change", "message"), PEOPLE.values(), ids=PEOPLE.keys())
def test_wrong_draws_are_refused(someone, change, message):
    refused(lambda: Person(human(), change(someone.draws)), message)


def test_sites_of_act_need_draws_too():
    """Else they would be sampled from the prior at each decision."""
    late = human_with_late()
    refused(lambda: Person(late, implants(2)), "there are no draws of the site late")
    draws = implants(2) | {"late": torch.full((2, 1, 1), 0.5)}
    assert Person(late, draws).number == 2


def human_with_late():
    from mirror_ppl.models.loading import load_human_model

    return load_human_model("docs/examples/late_reactions.py:LatePerson", human().self_model)


def test_a_person_is_of_a_human_model():
    refused(lambda: Person("mirror", implants()), "human must be of the class HumanModel, not 'mir")


# --- communicators -----------------------------------------------------------------------------


def test_numbers_of_any_kind_make_the_same_communicator(someone):
    one = Communicator(someone, ExpectedUtility(WORLD, 2), min_standard_errors=1.0, seed=3)
    utility = ExpectedUtility(WORLD, np.int64(2))
    other = Communicator(someone, utility, min_standard_errors=np.float32(1), seed=np.int64(3))
    assert one.plan(going_on(1)).gain == other.plan(going_on(1)).gain


OTHERS = {
    "draws": ({"person": {}}, "person must be of the class Person, not dict"),
    "a world": (
        {"objective": WORLD},
        "objective must be an objective, with the method at, not Sim",
    ),
    "a class": ({"objective": ExpectedUtility}, "with the method at, not ExpectedUtility"),
    "a number": ({"search": 3}, "search must be a search, with the method __call__, not 3"),
    "text": ({"min_standard_errors": "2"}, "min_standard_errors must be a number, not '2'"),
    "nan": ({"min_standard_errors": NAN}, "min_standard_errors must be at least 0, not nan"),
    "below 0": ({"min_standard_errors": -0.5}, "min_standard_errors must be at least 0, not -0.5"),
    "half a seed": ({"seed": 1.5}, "seed must be a whole number, not 1.5"),
    "a large seed": (
        {"seed": 2**60},
        "seed must be from 0 to 4294967295, not 1152",
    ),
}


@pytest.mark.parametrize(("change", "message"), OTHERS.values(), ids=OTHERS.keys())
def test_wrong_communicators_are_refused(someone, change, message):
    given = {"person": someone, "objective": ExpectedUtility(WORLD)} | change
    refused(lambda: Communicator(**given), message)


def test_another_world_is_refused(someone):
    other = SimulatorWorld(get_domain("bomb_defusal"))
    refused(
        lambda: Communicator(someone, ExpectedUtility(other)),
        "the objective must be of the world driving, not of bomb_defusal",
    )
    own = ExpectedUtility(SelfModelWorld(human().self_model))
    assert Communicator(someone, own).objective is own


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ExpectedUtility(DOMAIN), "must be a world such as SimulatorWorld(domain), with"),
        (lambda: ExpectedUtility(WORLD, 2.5), "horizon must be a whole number, not 2.5"),
        (
            lambda: SimulatorWorld("driving"),
            "must be a domain, with the method transition, not 'dri",
        ),
        (
            lambda: SelfModelWorld(human()),
            "self_model must be of the class SelfModel, not HumanMod",
        ),
        (lambda: SelfModelWorld(human().self_model, 0), "draws must be at least 1, not 0"),
    ],
)
def test_wrong_worlds_are_refused(make, message):
    refused(make, message)


@pytest.mark.parametrize("past", [None, NOW])
def test_a_plan_needs_a_round(communicator, past):
    refused(lambda: communicator.plan(past), "the round so far must be of the class RoundSoFar, no")

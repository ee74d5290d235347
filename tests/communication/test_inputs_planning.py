"""People and communicators from Python: any kind of number is taken, or refused."""

import numpy as np
import pytest
import torch
from example_inputs import KINDS, NAN, WORLD, going_on
from example_person import DOMAIN, human, implants
from refused import refused

from mirror_ppl.communication import (
    Communicator,
    ExpectedUtility,
    Person,
    SelfModelWorld,
    SimulatorWorld,
)
from mirror_ppl.domains import get_domain


@pytest.fixture
def someone():
    return Person(human(), implants(3, sight=2))


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

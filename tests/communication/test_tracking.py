"""Beliefs along a round go on from where they were, and are those of the whole round."""

import pickle

import pytest
import torch

from mirror_ppl.communication import person as person_module
from mirror_ppl.communication.hearing import HearingPerson
from mirror_ppl.communication.person import Person, PlanningContext
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.communication.tracking import PERCEPTS, Tracks
from mirror_ppl.models.belief_tracking import BeliefState
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate

STEPS = 8


def person_of(world, hears=None):
    human = load_human_model(None, load_self_model(shipped_weights(world), world)[0])
    draws = draw_prior(human, 1, 12, 1)
    return Person(human, draws) if hears is None else HearingPerson(human, draws, hears)


@pytest.fixture
def steps(monkeypatch):
    """Numbers of steps that beliefs were tracked through, in order."""
    found, through = [], BeliefState.through

    def counted(self, transitions):
        found.append(len(transitions))
        return through(self, transitions)

    monkeypatch.setattr(BeliefState, "through", counted)
    return found


@pytest.fixture(scope="module")
def rounds():
    return simulate("driving", "fog", "paper", 1, 2, 100, told=0.2)


def part(rounds, number, step):
    return RoundSoFar.of(rounds, "person-01", number, step)


@pytest.mark.parametrize("world", ["driving", "search_rescue", "bomb_defusal"])
@pytest.mark.parametrize("hears", [None, 0.7])
def test_a_round_step_by_step_is_the_whole_round(world, hears):
    """Also where attention or channels that reach the person are drawn anew at each step."""
    recorded = simulate(world, None, "paper", 1, 1, 100, told=0.2)
    person = person_of(world, hears)
    for step in range(STEPS):
        past = part(recorded, 0, step)
        found, expected = (
            PlanningContext.of(one, past) for one in (person, person_of(world, hears))
        )
        alike = [one.own[:, None] == one.own for one in (found, expected)]
        assert torch.equal(*alike)
        own, other = (one.before.believed[one.own] for one in (found, expected))
        torch.testing.assert_close(own, other, rtol=1e-4, atol=1e-4)
        assert found.before.step == step


def test_only_what_is_new_is_tracked(rounds, steps):
    person = person_of("driving")
    for step in range(STEPS):
        PlanningContext.of(person, part(rounds, 0, step))
    assert steps == [1] * (STEPS - 1) and len(person._tracks.kept) == 1
    PlanningContext.of(person, part(rounds, 0, STEPS - 1))
    PlanningContext.of(person, part(rounds, 0, 3))
    assert steps[STEPS - 1 :] == [3], "the present step again costs nothing, an earlier one is new"


@pytest.mark.parametrize("change", ["round", "message", "action", "observation"])
def test_another_course_is_tracked_anew(rounds, steps, change):
    person, past = person_of("driving"), part(rounds, 0, STEPS)
    PlanningContext.of(person, past)
    observation = {name: value.clone() for name, value in past.observation.items()}
    actions, told = past.actions.clone(), {n: mask.clone() for n, mask in past.told.items()}
    if change == "message":
        told["verbal"][2, 1] ^= True
    elif change == "action":
        actions[2] = 1 - actions[2]
    else:
        observation["visual"][2, 0, 0] += 1
    other = RoundSoFar(observation, actions, told)
    if change == "round":
        other = part(rounds, 1, STEPS)
    PlanningContext.of(person, other)
    assert steps == [STEPS, STEPS]


def test_buffers_that_are_used_again_do_not_change_what_is_kept(rounds, steps):
    person, past = person_of("driving"), part(rounds, 0, STEPS)
    past = RoundSoFar(
        {name: value.clone() for name, value in past.observation.items()}, past.actions, past.told
    )
    person.states(past)
    past.observation["visual"][2, 0, 0] += 1
    person.states(past)
    assert steps == [STEPS, STEPS]


def test_copies_in_other_processes_begin_empty(rounds):
    person = person_of("driving")
    person.states(part(rounds, 0, 2))
    assert person._tracks.kept and not pickle.loads(pickle.dumps(person._tracks)).kept


def test_what_is_not_yet_believed_may_differ(rounds, steps):
    """The present observation, and the action and messages after it."""
    person, past = person_of("driving"), part(rounds, 0, STEPS)
    PlanningContext.of(person, past)
    observation = {name: value.clone() for name, value in past.observation.items()}
    observation["visual"][-1, 0, 0] += 1
    now = {name: value[-1] for name, value in observation.items()}
    nothing = {name: torch.zeros_like(mask[0]) for name, mask in past.told.items()}
    other = RoundSoFar(observation, past.actions, past.told)
    PlanningContext.of(person, other.then(nothing, 0, now))
    assert steps == [STEPS, 1]


def test_some_of_the_percepts_are_found_among_all(rounds, steps):
    person, past = person_of("driving"), part(rounds, 0, STEPS)
    whole = person.states(past)
    some = torch.tensor([3, 0, 3])
    less = Person(person.human, {name: value[:4] for name, value in person.draws.items()})
    less._tracks = person._tracks
    less.percepts = {name: value[some] for name, value in person.percepts.items()}
    less.percept_count = 3
    found = less.states(past)
    assert steps == [STEPS]
    for one, all_ in zip(found, whole, strict=True):
        assert torch.equal(one.believed, all_.believed[some])
    less.percepts = {name: value + 1 for name, value in less.percepts.items()}
    less.states(past)
    assert steps == [STEPS, STEPS]


def test_many_percepts_are_not_kept(rounds):
    tracks, person, past = Tracks(), person_of("driving"), part(rounds, 0, 1)
    initial = BeliefState.initial(person.human, PERCEPTS + 1)
    percepts = {"sight": torch.arange(PERCEPTS + 1)}

    class Now(BeliefState):
        def through(self, transitions):
            return [self]

    tracks.through(percepts, past, Now(**vars(initial)), lambda first: [None])  # pyright: ignore
    assert not tracks.kept


def test_what_actions_say_of_hearing_is_added_up_once(rounds, monkeypatch):
    moments = []
    add = person_module.choices

    def counted(*args):
        moments.append(args)
        return add(*args)

    monkeypatch.setattr(person_module, "choices", counted)
    person = person_of("driving", hears=0.7)
    for step in range(STEPS):
        PlanningContext.of(person, part(rounds, 0, step))
    assert any(bool(told.any()) for told in part(rounds, 0, STEPS - 1).told.values())
    assert len(moments) == STEPS - 1
    del moments[:]
    PlanningContext.of(person, part(rounds, 1, STEPS - 1))  # another round
    assert len(moments) == STEPS - 1

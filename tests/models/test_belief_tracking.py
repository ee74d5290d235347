"""Tracked beliefs, against the recursion of the human model for each person by itself."""

from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from example_bomb import WAIT, course
from example_course import go_through

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains.base import RepeatedObservation, of_each
from mirror_ppl.domains.bomb_defusal.human import BombDefusalHuman
from mirror_ppl.likelihood.attention import attention_sites
from mirror_ppl.likelihood.combinations import discrete_sites
from mirror_ppl.models import HumanModel
from mirror_ppl.models.belief_tracking import NOT_SHOWN, BeliefState, Memory, Transition
from mirror_ppl.models.human import at_step, messages_at
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.row_appending import RowBuffer
from mirror_ppl.row_hashing import row_numbers

PEOPLE, STEPS = 60, 8


def drivers(generator):
    """Drivers in fog: a model, a round ``[1, T, ...]``, and actions ``[1, T]``."""
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc"))
    human = HumanModel(load_self_model(shipped_weights("driving"))[0])
    observation = {name: value[0, :1, :STEPS] for name, value in recordings.observation().items()}
    return human, observation, recordings.actions[0, :1, :STEPS]


def defusers(generator):
    """People who wait for most of a round, in which many beliefs stay as they are."""
    human = BombDefusalHuman(load_self_model(shipped_weights("bomb_defusal"))[0])
    done = [WAIT, WAIT, 1, WAIT, WAIT, WAIT, 2, WAIT]
    observation, _ = course(done)
    observation = {name: value[:, :STEPS] for name, value in observation.items()}
    return human, observation, torch.tensor([done])


@pytest.fixture(params=[drivers, defusers])
def case(request, generator):
    """A model, implants of people with different messages, and the transitions of a round."""
    human, observation, actions = request.param(generator)
    supports = discrete_sites(human) | attention_sites(human)
    implants = {
        name: own[torch.randint(min(len(own), 6), (PEOPLE,), generator=generator)]
        for name, own in supports.items()
    }
    # Of half of the people there are doubles.
    implants = {name: value[torch.arange(PEOPLE) % 45] for name, value in implants.items()}
    told = {
        m.name: (torch.rand(3, STEPS, len(m.items), generator=generator) < 0.1)[
            torch.arange(PEOPLE) % 3
        ]
        for m in human.domain.modalities
    }
    before = torch.cat([torch.tensor([len(human.domain.actions)]), actions[0, :-1]])
    transitions = [
        Transition(
            implants,
            before[step].expand(PEOPLE),
            at_step(observation, step),
            messages_at(told, step),
        )
        for step in range(STEPS)
    ]
    expected = [belief for _, belief in go_through(human, implants, observation, told, actions)]
    return human, observation, transitions, expected


@pytest.mark.parametrize("remembers", [False, True])
@torch.no_grad()
def test_beliefs_are_those_of_each_person_alone(case, remembers):
    human, observation, transitions, expected = case
    memory = Memory.of_rounds(human, observation) if remembers else None
    states = BeliefState.initial(human, PEOPLE, memory).through(transitions)
    for state, own in zip(states, expected, strict=True):
        torch.testing.assert_close(state.believed, own.expand(PEOPLE, -1), rtol=0, atol=1e-5)
    # They differ between people, and some are shared.
    assert 1 < len(states[-1].belief.unique()) < PEOPLE


@torch.no_grad()
def test_a_belief_that_stays_is_as_sure_as_it_was(case):
    human, _, transitions, _ = case
    states = BeliefState.initial(human, PEOPLE).through(transitions)
    views, _ = BeliefState.initial(human, PEOPLE).perceive(transitions)
    stayed = 0
    for step, (before, after) in enumerate(zip(states, states[1:], strict=False), 1):
        assert len(after.scale) == len(after.mean)
        still = views[step].still
        some = torch.zeros(PEOPLE, dtype=torch.bool) if still is None else still
        stayed += int(some.sum())
        assert torch.equal(after.scale[after.belief][some], before.scale[before.belief][some])
    # Each person alone has the same density, whoever else comes to the same mean.
    for person in range(0, PEOPLE, 7):
        alone = BeliefState.initial(human, 1)
        own = [
            replace(
                one,
                implants={name: value[[person]] for name, value in one.implants.items()},
                action=one.action[[person]],
                told={name: mask[[person]] for name, mask in one.told.items()},
            )
            for one in transitions
        ]
        for state, one in zip(states, alone.through(own), strict=True):
            torch.testing.assert_close(
                state.scale[state.belief[[person]]], one.scale, rtol=0, atol=1e-5
            )
    assert stayed or views[0].still is None


def alike(state):
    """Which two people have the same belief, up to rounding."""
    apart = state.believed[:, None] - state.believed
    return apart.abs().amax(-1) < 1e-5


@pytest.mark.parametrize("remembers", [False, True])
@torch.no_grad()
def test_steps_one_by_one_come_to_the_same(case, remembers):
    human, observation, transitions, _ = case
    memory = Memory.of_rounds(human, observation) if remembers else None
    state = BeliefState.initial(human, PEOPLE, memory)
    for transition, expected in zip(transitions, state.through(transitions), strict=True):
        state = state.after(transition)
        torch.testing.assert_close(state.believed, expected.believed, rtol=0, atol=1e-5)
        # Beliefs of different origin are one if equal to the last bit, which rounding decides.
        assert torch.equal(alike(state), alike(expected))
        assert torch.equal(state.key()[:, 1:], expected.key()[:, 1:])
        assert state.step == expected.step


@torch.no_grad()
def test_observations_of_their_own_are_as_one_that_is_shared(case):
    human, _, transitions, expected = case
    rows = torch.randperm(PEOPLE)
    apart = [
        replace(
            one,
            row=rows,
            observation={
                name: value.expand(PEOPLE, *value.shape[1:])
                for name, value in one.observation.items()
            },
        )
        for one in transitions
    ]
    for state, own in zip(BeliefState.initial(human, PEOPLE).through(apart), expected, strict=True):
        torch.testing.assert_close(state.believed, own.expand(PEOPLE, -1), rtol=0, atol=1e-5)


@torch.no_grad()
def test_a_belief_is_inferred_once(case, monkeypatch):
    """With a memory, nothing is inferred where the same came about before."""
    human, observation, transitions, _ = case
    inferred = []
    infer = type(human).infer

    def counted(self, belief, *rest):
        inferred.append(len(belief))
        return infer(self, belief, *rest)

    monkeypatch.setattr(type(human), "infer", counted)
    start = BeliefState.initial(human, PEOPLE, Memory.of_rounds(human, observation))
    states = start.through(transitions)
    causes = states[-1].memory.causes
    assert len(causes.unique(dim=0)) == len(causes)
    # A belief that stays is not inferred.
    nothing_new = row_numbers(torch.tensor([NOT_SHOWN, NOT_SHOWN]))
    assert (causes[:, 2] != nothing_new).sum() == sum(inferred)
    assert len(states[-1].mean.unique(dim=0)) == len(states[-1].mean) <= 1 + sum(inferred)
    first, index = states[-1].distinct()
    assert torch.equal(first.key()[index], states[-1].key())
    assert len(first.key().unique(dim=0)) == len(first.belief)


def test_rows_that_were_returned_never_change():
    buffer, parts = RowBuffer(), [torch.full((3, 2), float(part)) for part in range(6)]
    found, expected = [parts[0]], [parts[0]]
    # From the newest rows, from earlier ones, and from rows made elsewhere.
    for part, origin in zip(parts[1:], [0, 1, 1, 3, 2], strict=True):
        found.append(buffer.appended(found[origin], part))
        expected.append(torch.cat([expected[origin], part]))
    found.append(buffer.appended(found[-1][1:], parts[0]))
    expected.append(torch.cat([expected[-1][1:], parts[0]]))
    for rows, own in zip(found, expected, strict=True):
        assert torch.equal(rows, own)


def test_before_the_first_step_there_is_one_belief(case):
    human, *_ = case
    state, own = BeliefState.initial(human, 5).distinct()
    assert own.tolist() == [0] * 5 and state.mean.shape == (1, human.belief_size)
    assert not state.believed.any()
    assert state.step == 0


@dataclass
class Remembered:
    """What is on the road, and one number for each person ``[n]``."""

    cars: Any
    lane: torch.Tensor


class RemembersLane(HumanModel):
    """Has a memory of its own."""

    def nothing_known(self, *batch, device=None):
        lane = torch.zeros(batch, dtype=torch.long, device=device)
        return Remembered(super().nothing_known(*batch, device=device), lane)


def test_people_who_remember_different_numbers_are_distinct():
    human = RemembersLane(load_self_model(shipped_weights("driving"))[0])
    state = BeliefState.initial(human, 3)
    lanes = torch.tensor([1, 0, 1])
    for lane in (lanes, lanes.float(), lanes[:, None]):
        own = replace(state, knowledge=replace(state.knowledge, lane=lane))
        first, other, same = own.distinct()[1].tolist()
        assert first == same != other
    assert len(state.at(slice(0)).distinct()[1]) == 0


def test_what_many_observe_is_worked_out_once():
    row, calls = torch.tensor([1, 0, 1, 1]), []
    distinct = {"ego": torch.arange(4.0).view(2, 2), "visual": torch.zeros(2, 3, 1)}

    def doubled(observation):
        calls.append(observation)
        return 2 * observation["ego"]

    repeated = RepeatedObservation(distinct, row)
    assert torch.equal(of_each(doubled, repeated), 2 * distinct["ego"][row])
    assert calls == [distinct]
    assert {name: value.shape for name, value in repeated.items()} == {
        "ego": (4, 2),
        "visual": (4, 3, 1),
    }
    assert torch.equal(of_each(doubled, distinct), 2 * distinct["ego"])


@torch.no_grad()
def test_beliefs_that_stayed_are_those_of_the_step_before(case):
    human, _, transitions, _ = case
    before = BeliefState.initial(human, PEOPLE)
    stayed = 0
    for transition in transitions:
        after = before.after(transition)
        assert (after.stayed is None) == (human.perceive.__qualname__.startswith("HumanModel"))
        if after.stayed is not None:
            some = after.stayed >= 0
            stayed += int(some.sum())
            assert torch.equal(after.mean[some], before.mean[after.stayed[some]])
        before = after
    assert stayed or before.stayed is None


@torch.no_grad()
def test_a_model_with_the_same_believe_of_its_own_has_the_same_beliefs(case):
    """What does not change is then inferred again, which must make no difference."""
    human, _, transitions, _ = case

    class Own(type(human)):
        def believe(self, belief, evidence, action, still=None):
            return super().believe(belief, evidence, action, still)

    own = copy(human)
    own.__class__ = Own
    first, other = (BeliefState.initial(each, PEOPLE).through(transitions) for each in (human, own))
    for one, two in zip(first, other, strict=True):
        torch.testing.assert_close(one.believed, two.believed, rtol=0, atol=1e-5)
        torch.testing.assert_close(one.scale[one.belief], two.scale[two.belief], rtol=0, atol=1e-5)

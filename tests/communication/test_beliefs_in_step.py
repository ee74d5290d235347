"""Beliefs in planning, step by step: against the human model on whole rounds."""

import itertools

import pytest
import torch
from example_course import gone_through
from example_person import (
    ASSUMED,
    CHANNELS,
    DOMAIN,
    Averaging,
    Unused,
    begun,
    beliefs_before,
    flags,
    human,
    person,
    plan,
    random_round,
    self_model,
    varied_draws,
)
from example_plans import ACTIONS

from mirror_ppl.communication import Communicator, ExpectedUtility, Person, SimulatorWorld
from mirror_ppl.communication.person import PlanningContext
from mirror_ppl.models import HumanModel

KINDS = (HumanModel, Averaging)


class Tracks:
    """Random courses of action and messages of all percepts, from one round so far.

    Each is tracked step by step; ``expected`` goes through its whole round.
    With ``alike``, all do and hear the same.
    """

    def __init__(self, someone, past, horizon, number, generator, alike=False):
        self.person, self.past = someone, past
        self.rollouts = SimulatorWorld(DOMAIN).rollouts(past, horizon, generator)
        self.percept = torch.arange(number) % someone.percept_count
        # Few messages, so that some tracks hear and do the same.
        kinds = torch.rand(3, horizon, len(CHANNELS), generator=generator) < 0.15
        kinds[0] = False
        self.told = kinds[torch.randint(3, (number,), generator=generator)]
        self.actions = torch.randint(ACTIONS, (number, horizon), generator=generator)
        if alike:
            self.told[:], self.actions[:] = kinds[1], self.actions[:1].clone()
        self.path = torch.zeros(number, horizon, dtype=torch.long)
        for step in range(1, horizon):
            before, done = self.path[:, step - 1], self.actions[:, step - 1]
            self.path[:, step] = self.rollouts.follow(step - 1, before, done)

    def transition(self, step):
        if step > 0:
            action = self.actions[:, step - 1]
        else:
            last = self.past.actions[-1] if self.past.time else ACTIONS
            action = torch.full_like(self.percept, int(last))
        observation = {name: value[0] for name, value in self.rollouts.observation(step).items()}
        told = CHANNELS.split(self.told[:, step])
        return self.person.transition(self.percept, action, observation, told, self.path[:, step])

    def expected(self, step):
        """Beliefs ``[g, Z]`` at the end of whole rounds up to this step."""
        number, past = len(self.percept), self.past

        def whole(before, *after):
            before = before[: past.time].expand(number, *before[: past.time].shape)
            return torch.cat([before, *(part[:, None] for part in after)], 1)

        observation = {
            name: whole(value, *(o[name][0, self.path[:, h]] for h, o in self.upto(step)))
            for name, value in past.observation.items()
        }
        told = whole(CHANNELS.join(past.told), *self.told[:, : step + 1].unbind(1))
        done = whole(past.actions, *self.actions[:, : step + 1].unbind(1))
        percepts = {name: value[self.percept] for name, value in self.person.percepts.items()}
        heard = CHANNELS.split(told)
        return gone_through(self.person.human, percepts, observation, heard, done)[:, -1]

    def upto(self, step):
        return enumerate(self.rollouts.observation(each) for each in range(step + 1))


def person_of(kind, number, generator):
    """A person of a model of that class, with draws that differ in everything."""
    return Person(kind(self_model()), varied_draws(number, generator))


@pytest.fixture
def someone(generator):
    return Person(human(), varied_draws(8, generator))


@pytest.mark.parametrize("time", [0, 1, 5])
@pytest.mark.parametrize("kind", KINDS)
def test_beliefs_are_those_of_whole_rounds(generator, kind, time):
    someone = person_of(kind, 8, generator)
    past, _ = random_round(time, generator)
    tracks = Tracks(someone, past, 5, 120, generator)
    beliefs, own = beliefs_before(someone, past)
    parent = own[tracks.percept]
    for step in range(5):
        beliefs, parent = beliefs.at(parent).after(tracks.transition(step)).distinct()
        expected = tracks.expected(step)
        torch.testing.assert_close(beliefs.believed[parent], expected, rtol=0, atol=1e-5)
    # Messages, percepts and actions matter: of tracks that differ in one alone, some differ.
    apart = (expected[:, None] - expected).abs().amax(-1)
    parts = (tracks.told.flatten(1), tracks.percept[:, None], tracks.path[:, -1:])
    different = torch.stack([(part[:, None] != part).any(-1) for part in parts])
    for part in different:
        assert apart[part & (different.sum(0) == 1)].max() > 0.01


@pytest.mark.parametrize("time", [0, 1, 3, 8])
@pytest.mark.parametrize("kind", KINDS)
def test_beliefs_of_whoever_takes_things_for_granted_are_those_of_whole_rounds(
    generator, kind, time
):
    """Eyes of three kinds with each assumption and without; one matters where the other is made."""
    made = list(itertools.product((0, 1), repeat=2))
    matters = torch.zeros(3, 4, dtype=torch.bool)
    for _ in range(6):
        past, _ = random_round(time, generator, rate=0.15)
        sights = {name: torch.randint(5, (3,), generator=generator) for name in DOMAIN.directions}
        someone = person(
            12,
            kind(self_model()),
            **{name: value.repeat_interleave(4) for name, value in sights.items()},
            **dict(zip(ASSUMED, torch.tensor(made * 3).unbind(-1), strict=True)),
        )
        tracks = Tracks(someone, past, 6, someone.percept_count, generator, alike=True)
        beliefs, own = beliefs_before(someone, past)
        parent = own[tracks.percept]
        for step in range(6):
            beliefs, parent = beliefs.at(parent).after(tracks.transition(step)).distinct()
            mine, expected = beliefs.believed[parent], tracks.expected(step)
            torch.testing.assert_close(mine, expected, rtol=0, atol=1e-5)
            mine = mine[someone.percept].unflatten(0, (3, 4))
            apart = (mine[:, :, None] - mine[:, None]).abs().amax(-1)
            for index, (one, other) in enumerate(((0, 1), (2, 3), (0, 2), (1, 3))):
                matters[:, index] |= apart[:, one, other] > 0.01
    assert matters.any(0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_car_that_is_imagined_elsewhere_is_believed_elsewhere(generator, kind):
    """It draws away: shown at step 0 it is taken to be at 4 cells at step 2, and at step 1 at 6."""
    past, shown = begun(0, [6, 30, -30, -30], [1, 1, -1, -1]), flags(visual=["front-left"])
    tracks = Tracks(person(model=kind(self_model())), past, 3, 2, generator)
    tracks.told = torch.stack([plan(shown, None, None), plan(None, shown, None)])
    tracks.actions[:], tracks.path[:] = 0, 0
    beliefs, own = beliefs_before(tracks.person, past)
    parent = own[tracks.percept]
    for step in range(3):
        beliefs, parent = beliefs.at(parent).after(tracks.transition(step)).distinct()
        mine, expected = beliefs.believed[parent], tracks.expected(step)
        torch.testing.assert_close(mine, expected, rtol=0, atol=1e-5)
    # What is visible and taken for granted at the last step is the same.
    assert (mine[0] - mine[1]).abs().max() > 0.01


@pytest.mark.parametrize("time", [0, 4])
@pytest.mark.parametrize("kind", KINDS)
def test_each_belief_is_worked_out_once(generator, kind, time):
    """Fewer than there are looks: each is had by a person, and no two are alike."""
    someone = person_of(kind, 8, generator)
    past, _ = random_round(time, generator)
    tracks = Tracks(someone, past, 6, 200, generator)
    beliefs, own = beliefs_before(someone, past)
    parent = own[tracks.percept]
    for step in range(6):
        beliefs, parent = beliefs.at(parent).after(tracks.transition(step)).distinct()
        torch.testing.assert_close(
            beliefs.believed[parent], tracks.expected(step), rtol=0, atol=1e-5
        )
        assert len(beliefs.belief) < 200
        assert parent.unique().tolist() == list(range(len(beliefs.belief)))
        assert beliefs.belief.unique().tolist() == list(range(len(beliefs.mean)))
        assert len(beliefs.mean.unique(dim=0)) == len(beliefs.mean)
        assert (beliefs.scale is None) == (kind is Averaging)


def test_the_last_action_and_all_messages_so_far_are_in_a_belief(someone, generator):
    """A change of any of them in the round so far changes the next belief, as it does in rounds."""
    past, _ = random_round(3, generator)

    def next_belief(past):
        tracks = Tracks(someone, past, 1, someone.percept_count, torch.Generator().manual_seed(0))
        beliefs, own = beliefs_before(someone, past)
        beliefs = beliefs.at(own[tracks.percept]).after(tracks.transition(0))
        torch.testing.assert_close(beliefs.believed, tracks.expected(0), rtol=0, atol=1e-5)
        return beliefs.believed

    base = next_belief(past)
    for step in range(3):
        actions = past.actions.clone()
        actions[step] = 1 - actions[step]
        changed = type(past)(past.observation, actions, past.told)
        assert (next_belief(changed) - base).abs().max() > 1e-3
        told = {name: mask.clone() for name, mask in past.told.items()}
        told["verbal"][step] = ~told["verbal"][step]
        changed = type(past)(past.observation, past.actions, told)
        assert (next_belief(changed) - base).abs().max() > 1e-3


@pytest.mark.parametrize("time", [0, 3])
def test_a_model_that_remembers_more_stands_in_a_round_with_its_memory(generator, time):
    past, _ = random_round(time, generator)
    someone = person_of(Averaging, 4, generator)
    tracks = Tracks(someone, past, 4, 40, generator)
    context = PlanningContext.of(someone, past)
    beliefs, parent = context.before, context.own[tracks.percept]
    for step in range(4):
        beliefs, parent = beliefs.at(parent).after(tracks.transition(step)).distinct()
    mine = beliefs.believed[parent]
    torch.testing.assert_close(mine, tracks.expected(3), rtol=0, atol=1e-5)
    last, average, number = someone.human.parts(mine)
    assert (number == time + 4).all()
    # Besides what they would believe if they did not look back.
    tracks.person = Person(human(), someone.draws)
    torch.testing.assert_close(last, tracks.expected(3), rtol=0, atol=1e-5)
    assert (average - last).abs().max() > 0.01


def test_a_memory_that_is_not_used_leaves_decisions_as_they_are(generator):
    past, _ = random_round(3, generator)
    draws = varied_draws(6, generator)
    usual, same = (
        Communicator(
            Person(model(self_model()), draws),
            ExpectedUtility(SimulatorWorld(DOMAIN), 4, enumerate_above=0),
        ).plan(past)
        for model in (HumanModel, Unused)
    )
    assert torch.equal(usual.flags, same.flags)
    assert usual.gain.mean == pytest.approx(same.gain.mean, abs=1e-4)
    assert torch.equal(usual.found.candidates, same.found.candidates)
    torch.testing.assert_close(
        usual.found.valued.utility, same.found.valued.utility, rtol=0, atol=1e-4
    )

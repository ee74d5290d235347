"""Beliefs in planning: against the human model on whole rounds, one by one."""

import itertools

import pytest
import torch
from example_course import gone_through, perceived
from example_person import (
    CHANNELS,
    DOMAIN,
    FULL_SIGHT,
    Averaging,
    Unused,
    begun,
    beliefs_before,
    flags,
    human,
    implants,
    person,
    plan,
    random_round,
    self_model,
    varied_draws,
)

from mirror_ppl.communication import Communicator, ExpectedUtility, Person, SimulatorWorld
from mirror_ppl.communication.person import PlanningContext
from mirror_ppl.errors import HumanModelError
from mirror_ppl.models import HumanModel
from mirror_ppl.models.belief_tracking import BeliefState
from mirror_ppl.models.implants import assumption_sites

ACTIONS = len(DOMAIN.actions)
KINDS = (HumanModel, Averaging)
ASSUMED = assumption_sites(DOMAIN)


# --- a person ---------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [None, 0])
def test_without_draws_there_is_no_person(number):
    draws = {} if number is None else implants(number)
    with pytest.raises(HumanModelError) as error:
        Person(human(), draws)
    assert str(error.value) == "planning needs at least one posterior draw"


@pytest.mark.parametrize("site", ["sight_back_own", *ASSUMED, "consistency", "residual_out"])
def test_a_site_without_draws_is_refused(site):
    draws = implants(3)
    del draws[site]
    with pytest.raises(HumanModelError) as error:
        Person(human(), draws)
    assert str(error.value) == f"there are no draws of the site {site}"


def test_all_sites_without_draws_are_named():
    draws = implants(3)
    del draws["sight_front_own"], draws["lapse"]
    with pytest.raises(HumanModelError, match=r"of the site sight_front_own, lapse$"):
        Person(human(), draws)


def test_draws_with_the_same_perception_share_an_percept():
    values = {
        "sight_front_own": [1, 2, 1, 1, 2, 1, 1],
        "assumes_clear": [0, 0, 0, 1, 0, 0, 0],
        "assumes_closing": [1, 1, 1, 1, 1, 1, 0],
    }
    someone = person(7, **values, lapse=[0.1] * 5 + [0.2] * 2)
    assert someone.number == 7
    assert someone.percept_count == 4
    groups = [[0, 2, 5], [1, 4], [3], [6]]
    for group in groups:
        assert len(set(someone.percept[group].tolist())) == 1
    assert len(set(someone.percept.tolist())) == 4
    for name, value in values.items():
        assert someone.percepts[name][someone.percept].tolist() == value
    # Sites that are not discrete say nothing of percepts.
    assert "lapse" not in someone.percepts


def test_everybody_sees_for_themselves():
    past = begun(0, [3, 9, -2, -9], [-1, 1, 1, -1])
    someone = person(
        3,
        front_own=[0, 4, 4],
        back_own=[2, 0, 0],
        assumes_clear=[0, 1, 1],
        assumes_closing=[1, 1, 0],
    )
    observation = {name: value.expand(3, 1, *value.shape) for name, value in past.now.items()}
    nothing = CHANNELS.split(torch.zeros(3, 1, len(CHANNELS), dtype=torch.bool))
    view = perceived(
        human(), {n: v[someone.percept] for n, v in someone.percepts.items()}, observation, nothing
    )
    behind, ahead = [False, False, True, False], [True, False, False, False]
    assert view.visible["visual"][:, 0].tolist() == [behind, ahead, ahead]
    others = [False, True, True, True]
    assert view.taken["visual"][:, 0].tolist() == [[False] * 4, others, others]
    # How the car moves that they see can only be assumed: closer, from behind and from ahead.
    assert view.taken["verbal"][:, 0].tolist() == [behind, ahead, [False] * 4]
    assert view.imagined["verbal"][0, 0, 2].tolist() == [-2, 0, 1]
    assert view.imagined["verbal"][1, 0, 0].tolist() == [3, 0, -1]
    assert view.visible["verbal"].shape == (3, 1, 4)
    assert not view.visible["verbal"].any()
    # A look at one step is the same, and tells what they have learned.
    rows = torch.arange(3)
    first = {name: value[:, 0] for name, value in observation.items()}
    told = {name: mask[:, 0] for name, mask in nothing.items()}
    transition = someone.transition(someone.percept, told["visual"][:, 0], first, told, rows)
    look, (after,) = BeliefState.initial(human(), 3).perceive([transition])
    assert torch.equal(look.numbers(), view.numbers())
    assert after.unsure.tolist() == [behind, ahead, ahead]


def test_each_draw_acts_by_its_own_implants(generator):
    draws = varied_draws(3, generator)
    someone = Person(human(), draws)
    belief = torch.randn(3, 4, self_model().latent, generator=generator)
    values = torch.randn(3, 4, ACTIONS, generator=generator)
    together = someone.act(belief, values)
    assert together.shape == (3, 4, ACTIONS)
    for s, m in itertools.product(range(3), range(4)):
        own = {name: value[s] for name, value in draws.items()}
        alone = human().act(own, belief[s, m][None, None], values[s, m][None, None])
        torch.testing.assert_close(together[s, m], alone[0, 0])
    # Where draws share beliefs it is as if each had them.
    shared = someone.act(belief[:1], values[:1])
    torch.testing.assert_close(shared, someone.act(belief[:1].expand(3, -1, -1), values[:1]))


# --- beliefs in step --------------------------------------------------------------------------


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


# --- which beliefs are shared -----------------------------------------------------------------


def look_around(someone, past, messages):
    """Beliefs after each percept's look with each message ``[M, N]``; which one, ``[M, U]``."""
    beliefs, own = beliefs_before(someone, past)
    percept = torch.arange(someone.percept_count).repeat(len(messages))
    last = int(past.actions[-1]) if past.time else ACTIONS
    transition = someone.transition(
        percept,
        torch.full_like(percept, last),
        {name: value[None] for name, value in past.now.items()},
        CHANNELS.split(messages.repeat_interleave(someone.percept_count, 0)),
    )
    beliefs, index = beliefs.at(own[percept]).after(transition).distinct()
    return beliefs, index.view(len(messages), -1)


def test_percepts_that_see_the_same_share_a_belief():
    # Thresholds are 0, 1, 2, 3, 4, 6 and 12 cells; the only car is 4 cells ahead.
    past = begun(0, [4, 30, -30, -30], [-1, 1, -1, -1])
    someone = person(5, front_own=[0, 2, 3, 4, 5])
    assert someone.percept_count == 5
    beliefs, which = look_around(someone, past, flags()[None])
    which = which[0, someone.percept]
    assert len(beliefs.mean) == 2
    assert (which[:3] == which[0]).all() and (which[3:] == which[3]).all()
    assert which[0] != which[3]


def test_words_that_make_all_percepts_see_the_same_make_their_beliefs_the_same():
    past = begun(0, [4, 30, -30, -30], [-1, 1, -1, -1])
    someone = person(2, front_own=[0, FULL_SIGHT])
    shown = flags(visual=["front-left"])
    beliefs, which = look_around(someone, past, torch.stack([flags(), shown]))
    silence, told = beliefs.believed[which]
    assert not torch.allclose(silence[0], silence[1])
    torch.testing.assert_close(told[0], told[1], rtol=0, atol=0)


def test_what_percepts_saw_before_keeps_their_beliefs_apart():
    """At first one sees the car and the other does not; then it is far from both."""
    past = begun(0, [4, 30, -30, -30], [1, 1, -1, -1])
    later = begun(0, [11, 30, -30, -30], [1, 1, -1, -1]).now
    past = past.then(CHANNELS.split(flags()), 0, later)
    for clear, closing in itertools.product((0, 1), repeat=2):
        someone = person(2, front_own=[3, 4], assumes_clear=clear, assumes_closing=closing)
        beliefs, which = look_around(someone, past, flags()[None])
        assert len(set(which[0].tolist())) == 2
        assert not torch.allclose(*beliefs.believed[which[0]])
    # Two who both saw nothing share their beliefs from the beginning on.
    beliefs, own = beliefs_before(person(2, front_own=[2, 3]), past)
    assert len(beliefs.mean) == 1
    assert own.tolist() == [0, 0]


@pytest.mark.parametrize("assumption", ASSUMED)
def test_assumptions_change_beliefs(assumption):
    """Of one car seen and three out of sight, until all are spoken of."""
    past = begun(0, [4, 9, -5, -9], [-1, 1, -1, -1])
    someone = person(2, front_own=4, **{assumption: [0, 1]})
    beliefs, which = look_around(someone, past, flags()[None])
    assert len(set(which[0].tolist())) == 2
    assert (beliefs.believed[which[0, 0]] - beliefs.believed[which[0, 1]]).abs().max() > 0.01
    spoken = flags(verbal=["front-left", "front-right", "rear-left", "rear-right"])
    _, which = look_around(someone, past, spoken[None])
    assert len(set(which[0].tolist())) == 1


# --- models that remember more ----------------------------------------------------------------


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


def test_items_are_informative_where_a_person_does_not_know_them_yet():
    # One sees two cells ahead, the other nothing.
    two = DOMAIN.reach_bins.index(2.0)
    someone = person(2, front_own=[two, 0], front_other=[two, 0])
    past = begun(0, [2, 9, -9, -30], [-1, 1, 1, -1])
    allowed = CHANNELS.join(DOMAIN.communicable(past.now))
    assert torch.equal(PlanningContext.of(someone, past).telling(allowed), allowed)
    told = CHANNELS.split(flags(verbal=["rear-left"]))
    past = past.then(told, 0, begun(0, [1, 10, -8, -30], [-1, 1, 1, -1]).now)
    # Whoever heard of a car knows where it is; of the others they may learn more.
    left = allowed & ~flags(visual=["rear-left"], verbal=["rear-left"])
    assert torch.equal(PlanningContext.of(someone, past).telling(allowed), left)
    # The first knows the car in front, having seen it twice; the second does not.
    sighted = person(1, front_own=two, front_other=two)
    left &= ~flags(["front-left"], ["front-left"])
    assert torch.equal(PlanningContext.of(sighted, past).telling(allowed), left)
    # Of a model that remembers more it is the same.
    sighted = person(1, Averaging(self_model()), front_own=two, front_other=two)
    assert torch.equal(PlanningContext.of(sighted, past).telling(allowed), left)

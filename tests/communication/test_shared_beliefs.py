"""Which beliefs are shared in planning, and which are kept apart."""

import itertools

import pytest
import torch
from example_person import ASSUMED, CHANNELS, FULL_SIGHT, begun, beliefs_before, flags, person
from example_plans import ACTIONS


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
    """One car is seen and three are out of sight, until there are messages about all."""
    past = begun(0, [4, 9, -5, -9], [-1, 1, -1, -1])
    someone = person(2, front_own=4, **{assumption: [0, 1]})
    beliefs, which = look_around(someone, past, flags()[None])
    assert len(set(which[0].tolist())) == 2
    assert (beliefs.believed[which[0, 0]] - beliefs.believed[which[0, 1]]).abs().max() > 0.01
    spoken = flags(verbal=["front-left", "front-right", "rear-left", "rear-right"])
    _, which = look_around(someone, past, spoken[None])
    assert len(set(which[0].tolist())) == 1

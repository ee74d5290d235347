"""A communicator in another program's loop."""

import numpy as np
import pytest
import torch
from example_person import CHANNELS, DOMAIN, human

from mirror_ppl.communication import (
    Communicator,
    Companion,
    ExpectedUtility,
    Person,
    RoundSoFar,
    SimulatorWorld,
)
from mirror_ppl.communication.hearing import hearing
from mirror_ppl.errors import InputError, UnknownNameError
from mirror_ppl.models.prior import draw_prior

QUIET = {"visual": (), "verbal": ()}


@pytest.fixture
def communicator():
    person = hearing(Person(human(), draw_prior(human(), 1, 8, 0)), 0.9)
    return Communicator(person, ExpectedUtility(SimulatorWorld(DOMAIN), 3))


def rounds(seed):
    state = DOMAIN.initial(1, torch.Generator().manual_seed(seed))
    while True:
        yield {name: value[0].numpy() for name, value in DOMAIN.observe(state).items()}
        state = DOMAIN.transition(state, torch.tensor([0]))


def test_it_decides_as_the_communicator_does_with_all_that_happened(communicator):
    companion = Companion(communicator)
    seen = rounds(3)
    first = next(seen)
    companion.begin(first)
    past = RoundSoFar.begin(DOMAIN, first)
    for message in (None, {"verbal": ["rear-left"]}, None):
        decision = companion.decide()
        assert decision is companion.decide()
        assert torch.equal(decision.flags, communicator.plan(past).flags)
        now = next(seen)
        companion.observe(now, 0, message)
        told = CHANNELS.split(CHANNELS.flags(message)) if message else decision.told
        past = past.then(told, 0, now)
    for name, mask in past.told.items():
        assert torch.equal(companion.past.told[name], mask)
    companion.begin(first)
    learned = communicator.after(past).person
    assert companion.past.time == 0
    assert companion.communicator.person.hears == learned.hears
    assert learned.hears != communicator.person.hears


def test_what_was_really_said_counts(communicator):
    companion, seen = Companion(communicator), rounds(3)
    companion.begin(next(seen))
    companion.decide()
    companion.observe(next(seen), 0, {"verbal": ["rear-left"]})
    assert companion.past.told["verbal"][0].tolist() == [False, False, True, False]
    companion.observe(next(seen), "stay")  # nothing was decided
    assert companion.past.actions.tolist() == [0, 0]
    assert not companion.past.told["verbal"][1].any()
    with pytest.raises(UnknownNameError, match="unknown verbal item"):
        companion.observe(next(seen), 0, {"verbal": ["above"]})
    for message in ("rear-left", ["rear-left"], 5, {"verbal": "rear-left"}, {"verbal": 3}):
        with pytest.raises(InputError, match="a message has lists of names by modality, as"):
            companion.observe(next(rounds(3)), 0, message)


def test_what_cannot_be_is_refused_and_changes_nothing(communicator):
    companion, seen = Companion(communicator), rounds(3)
    with pytest.raises(InputError, match="no round has begun"):
        companion.decide()
    first = next(seen)
    with pytest.raises(InputError, match="lane has to be 0 or 1"):
        companion.begin(first | {"ego": np.array([7.0])})
    companion.begin(first)
    now = next(seen)
    for bad, message in (
        ((now, 9), "there is no action 9"),
        ((now, 0.5), "whole"),
        (({"ego": now["ego"]}, 0), "observation"),
        ((now | {"visual": now["visual"][:2]}, 0), "shape"),
        ((now | {"visual": now["visual"] + np.nan}, 0), "nan"),
        (("nothing", 0), "observation"),
    ):
        with pytest.raises(InputError, match=message):
            companion.observe(*bad)
        assert companion.past.time == 0
    with pytest.raises(UnknownNameError, match='; perhaps you meant "stay"'):
        companion.observe(now, "sty")
    assert companion.past.time == 0
    for _ in range(DOMAIN.horizon):
        companion.observe(now, 0, QUIET)
        now = next(seen)
    assert companion.decide().why() == "silence: the round is over"
    with pytest.raises(InputError, match="the round is over after its 15 steps; call begin"):
        companion.observe(now, 0)
    with pytest.raises(InputError, match="communicator"):
        Companion("mirror")

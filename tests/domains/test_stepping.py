"""Environments that other processes step: the same outcomes, and what happens where they fail."""

import os
import pickle
from operator import itemgetter
from threading import Lock

import gymnasium as gym
import pytest
import torch
from stepped_worlds import Random, Walk, Way

from mirror_ppl.domains import stepped_world
from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.registry import know
from mirror_ppl.errors import DomainError
from mirror_ppl.stepping import stepped_by

PAID = "mirror_ppl_tests/Paid-v0"
TENS = torch.arange(10.0)[:, None]
GO = torch.ones((), dtype=torch.long)


@pytest.fixture
def registered():
    gym.register(id=PAID, entry_point=Walk)
    yield
    del gym.registry[PAID]


class PaidByProcess(Way):
    """Rewards are the number of the process that steps; other processes do not register it."""

    def make(self):
        return gym.make(PAID).unwrapped

    def terms(self, env, action, reward, terminated):
        return {"reward": os.getpid()}


def paid(world, state):
    following = world.transition(state, GO)
    return set(world.rewards(state, GO, following)["reward"].long().tolist()), following


def test_other_processes_step_where_that_takes_long(monkeypatch, registered):
    own, way = PaidByProcess(), know(PaidByProcess())
    state = way.state_behind({"ego": TENS, "visual": 10 - TENS[..., None]})
    some, others = (map_state(itemgetter(rows), state) for rows in (slice(5), slice(5, 9)))
    with stepped_by(2, way):
        assert paid(way, some)[0] == {os.getpid()}  # it is soon done
        monkeypatch.setattr(stepped_world, "WORTH_SHARING", 0.0)
        monkeypatch.setattr(stepped_world, "SLOW", 0.0)
        processes, following = paid(way, others)
        assert processes and os.getpid() not in processes
        assert pickle.loads(pickle.dumps(way)).elsewhere is None
    assert paid(way, state)[0] == processes | {os.getpid()}  # known by now
    assert torch.equal(following.values, own.transition(others, GO).values)


def test_what_other_processes_cannot_step_is_stepped_here(monkeypatch, registered):
    way = PaidByProcess()
    way.lock = Lock()
    monkeypatch.setattr(stepped_world, "WORTH_SHARING", 0.0)
    monkeypatch.setattr(stepped_world, "SLOW", 0.0)
    state = way.state_behind({"ego": TENS, "visual": 10 - TENS[..., None]})
    with stepped_by(2, way), pytest.warns(UserWarning, match="in one process, as .*cannot pickle"):
        assert paid(way, state)[0] == {os.getpid()}


def test_a_fault_that_other_processes_find_is_an_error(monkeypatch, registered):
    way = type("Wild", (PaidByProcess,), {"make": lambda self: Random()})()
    way._left_to_try.clear()  # here it is no longer tried
    monkeypatch.setattr(stepped_world, "WORTH_SHARING", 0.0)
    monkeypatch.setattr(stepped_world, "SLOW", 0.0)
    state = way.state_behind({"ego": TENS, "visual": 10 - TENS[..., None]})
    with stepped_by(2, way), pytest.raises(DomainError, match="vary; restore"):
        way.transition(state, GO)

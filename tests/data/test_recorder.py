"""Rounds that are played in environments: what is kept, and what is refused where it happens."""

import gymnasium as gym
import numpy as np
import pytest
from stepped_worlds import Endless, Swing, Walk, Way, Wind, Windy

from mirror_ppl.data.contradictions import check_world
from mirror_ppl.data.recorder import Recorder
from mirror_ppl.domains import Control, Modality, add_domain
from mirror_ppl.domains.registry import know
from mirror_ppl.domains.stepped_world import SteppedWorld
from mirror_ppl.errors import DomainError, InputError


class Track(gym.Env):
    observation_space = gym.spaces.Box(0, 99, (1,))
    action_space = gym.spaces.Box(1, 5, (1,), dtype=np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0.0
        return np.array([0.0]), {}

    def step(self, action):
        self.place += float(action[0])
        return np.array([self.place]), 0.0, False, False, {}


class Fast(SteppedWorld):
    modalities = (Modality("visual", ("end",), ("offset",), ("m",), (40.0,), 0.01),)
    ego_features = ("nothing",)
    controls = (Control("speed", 1, 5),)
    horizon = 4

    def make(self):
        return Track()

    def look(self, env):
        return {"ego": [0.0], "visual": [[40.0 - env.place]]}

    def restore(self, env, observation):
        env.place = 40.0 - float(observation["visual"][0, 0])


def test_played_controls_are_recorded():
    swing = add_domain(Swing)
    env = Recorder(swing.make(), swing, person="ada")
    env.reset(seed=5)
    torques = (-2.0, 0.3, 1.6, 1.4, 0.0)
    earned = [env.step(np.array([torque], np.float32))[1] for torque in torques]
    with pytest.raises(InputError, match="over"):
        env.step(np.zeros(1))
    env.reset()
    with pytest.raises(InputError, match=r"shape \(1,\), torque -2 to 2; \[5.0\] is out of bounds"):
        env.step(np.array([5.0]))
    found = env.recordings()
    assert found.controls.flatten().tolist() == pytest.approx([-2.0, 0.3, 1.6, 1.4, 0.0])
    assert found.actions.flatten().tolist() == [0, 2, 4, 3, 2]
    assert found.rewards.flatten().tolist() == pytest.approx(earned)
    assert check_world(found, 0.0).share == 0


def test_rounds_of_different_lengths_do_not_contradict_controls_without_0():
    drive = add_domain(type("Drive", (Fast,), {}))
    env = Recorder(drive.make(), drive)
    for steps in (2, 4):
        env.reset(seed=0)
        for _ in range(steps):
            env.step(np.array([3.0]))
    assert check_world(env.recordings(), 0.0).share == 0


def test_controls_are_executed_as_they_are_recorded():
    drive = add_domain(Fast)
    env = Recorder(drive.make(), drive)
    env.reset(seed=0)
    env.step(np.array([5.001]))  # within a thousandth of a level
    assert env.recordings().controls.tolist() == [[[[5.0]]]]
    assert env.unwrapped.place == 5.0


class Halved(gym.Wrapper):
    """Changes the action that it is given."""

    def step(self, action):
        action /= 2
        return self.env.step(action)


class Slow(Fast):
    def make(self):
        return Halved(Track())


def test_controls_of_any_kind_are_recorded():
    slow = add_domain(Slow)
    env = Recorder(slow.make(), slow)
    env.reset(seed=0)
    for action in ([1.5], np.array([3.0]), np.array([3.5], np.float32)):
        env.step(np.asarray(action))
    fast = add_domain(Fast)
    whole = Recorder(fast.make(), fast)
    whole.reset(seed=0)
    for action in ([2], np.array([3], np.int8), np.array([4], object)):
        whole.step(action)
    assert env.recordings().controls.flatten().tolist() == [1.5, 3.0, 3.5]
    assert whole.recordings().controls.flatten().tolist() == [2.0, 3.0, 4.0]


def test_a_session_is_refused_where_it_goes_wrong():
    way = Way()
    with pytest.raises(InputError, match="way is not known; add it first"):
        Recorder(way.make(), way)
    env = Recorder(way.make(), add_domain(way))
    with pytest.raises(InputError, match="has not begun"):
        env.tell("visual", "end")
    env.person = ""
    with pytest.raises(InputError, match="person has to be a name, not ''"):
        env.reset(seed=0)
    env.person = "ada"
    env.reset(seed=0)
    for other in (True, 1.0, "1", np.array([1])):
        with pytest.raises(InputError, match="action has to be one of"):
            env.step(other)
    env.step(np.int64(1))
    env.unwrapped.step = lambda action: 1 / 0
    with pytest.raises(ZeroDivisionError):
        env.step(1)
    with pytest.raises(InputError, match="call reset"):
        env.step(1)


def test_recorded_rounds_end_where_the_world_says_so():
    way = know(Endless())  # its check would find the fault
    env = Recorder(way.make(), way)
    env.reset(seed=next(seed for seed in range(99) if _place(way, seed) == 7))
    env.step(1)
    env.step(1)
    with pytest.raises(DomainError, match=r"endless: .* is terminated after 1 in .*done"):
        env.step(1)


def test_rounds_do_not_go_on_where_the_world_has_ended():
    early = know(type("Early", (Way,), {"done": lambda self, env: env.place >= 9})())
    env = Recorder(early.make(), early)
    env.reset(seed=next(seed for seed in range(99) if _place(early, seed) == 7))
    env.step(1)
    with pytest.raises(DomainError, match=r"early: .* is not terminated after 1 in .*done"):
        env.step(1)


def test_a_task_that_is_done_at_the_horizon_is_not_truncated():
    way = add_domain(Way)
    env = Recorder(way.make(), way)
    for place, steps in ((7, [(True, False)]), (6, [(False, True)])):
        env.reset(seed=next(seed for seed in range(99) if _place(way, seed) == place))
        ends = [env.step(action)[2:4] for action in (0, 0, 0, 1, 1, 1)]
        assert ends == [(False, False)] * (way.horizon - 1) + steps
        with pytest.raises(InputError, match="call reset"):
            env.step(1)


class Ends(Way):
    """As many ends as the environment has."""

    def look(self, env):
        return {"ego": [env.place], "visual": [[10 - env.place]] * getattr(env, "ends", 1)}


def test_steps_have_to_be_those_of_the_world():
    way = add_domain(Way)
    env = Recorder(gym.wrappers.TransformReward(way.make(), lambda reward: 2 * reward), way)
    env.reset(seed=0)
    env.step(0)
    with pytest.raises(
        InputError, match=r"step 1: after 1, reward is 2.0 .*computed as 1.0.*wrappers"
    ):
        env.step(1)
    with pytest.raises(InputError, match="call reset"):
        env.step(1)
    assert env.recordings().lengths.tolist() == [[1]]  # without the step that was wrong
    with pytest.raises(DomainError, match=r"look.. has ego \(1,\), visual \(2, 1\), expected ego"):
        Recorder(type("Two", (Walk,), {"ends": 2})(), add_domain(Ends)).reset(seed=0)
    env = Recorder(Wind(), way)
    with pytest.raises(InputError, match=r"step \d: after 1, ego is .*steps are random"):
        for _ in range(20):  # gusts of one step are the world's
            env.reset(seed=0)
            env.step(1)


def test_chance_differs_between_rounds_and_is_that_of_the_world():
    windy = add_domain(Windy)
    env = Recorder(windy.make(), windy)
    for _ in range(60):
        env.reset(seed=0)
        env.step(1)
    # All equal with a probability of 1e-28.
    assert env.recordings().ego[0, :, 1, 0].unique().numel() > 1


def _place(way, seed):
    env = way.make()
    env.reset(seed=seed)
    return env.place

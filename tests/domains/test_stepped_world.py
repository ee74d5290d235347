"""Gymnasium environments that are stepped when needed: equal to the environment, and refusals."""

import pickle
import re
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from stepped_worlds import Endless, Random, Swing, Walk, Way, Wind, Windy

from mirror_ppl.domains import Control, Modality
from mirror_ppl.domains.capabilities import remarks_on
from mirror_ppl.domains.checking import faults_of
from mirror_ppl.domains.gymnasium_world import GymnasiumWorld
from mirror_ppl.domains.registry import load_world
from mirror_ppl.domains.stepped_world import SteppedWorld
from mirror_ppl.errors import DomainError


@pytest.mark.parametrize("kind", [Swing, Way, Windy])
def test_such_worlds_keep_the_contract(kind):
    assert faults_of(kind()) == []


def test_pendulum_moves_as_when_it_is_stepped():
    swing, chooser = Swing(), np.random.default_rng(0)
    env = swing.make()
    env.reset(seed=3)
    begin = {n: torch.tensor(np.array(v)).float() for n, v in swing.look(env.unwrapped).items()}
    state = swing.state_behind({n: v[None] for n, v in begin.items()})
    for step in range(20):
        torque = chooser.uniform(-2, 2, 1)
        _, reward, _, _, _ = env.step(torque)
        action = torch.tensor(torque[None]).float()
        following = swing.transition(state, action)
        assert float(swing.rewards(state, action, following)["reward"]) == pytest.approx(
            float(reward), abs=1e-3
        )
        # The state is known to the rounding of 32 bits, which grows from step to step.
        for name, value in swing.look(env.unwrapped).items():
            assert np.allclose(swing.observe(following)[name][0], value, atol=1e-5 * (step + 1))
        state = following


def test_actions_are_the_controls_that_they_stand_for():
    swing = Swing()
    state = swing.initial(4, torch.Generator().manual_seed(0))
    action = torch.tensor([0, 1, 3, 4])
    values = torch.tensor([[-2.0], [-1.0], [1.0], [2.0]])
    assert torch.equal(
        swing.transition(state, action).values, swing.transition(state, values).values
    )


def test_what_is_done_stays_so_and_earns_nothing():
    way = Way()
    state = way.state_behind({"ego": torch.tensor([[9.0]]), "visual": torch.tensor([[[1.0]]])})
    go = torch.tensor([1])
    end = way.transition(state, go)
    assert bool(way.over(end)) and not bool(way.over(state))
    assert float(way.rewards(state, go, end)["reward"]) == 1
    assert torch.equal(way.transition(end, go).values, end.values)
    assert float(way.rewards(end, go, end)["reward"]) == 0
    assert bool(way.over(way.state_behind(way.observe(end))))


def test_other_processes_make_their_own_environment():
    way = Way()
    state = way.initial(3, torch.Generator().manual_seed(0))
    again = pickle.loads(pickle.dumps(way))
    assert "_env" not in vars(again)
    go = torch.ones(3, dtype=torch.long)
    assert torch.equal(again.transition(state, go).values, way.transition(state, go).values)


class Forgetful(Way):
    def restore(self, env, observation):
        env.place = 0


class Idle(Way):
    def restore(self, env, observation):
        pass


class Sliding(Walk):
    """Who goes slides on, faster from step to step."""

    def reset(self, *, seed=None, options=None):
        self.speed = 0
        return super().reset(seed=seed)

    def step(self, action):
        self.speed += int(action)
        return super().step(self.speed)


class Unseen(Way):
    """The speed is neither observed nor restored as it was."""

    def make(self):
        return Sliding()

    def restore(self, env, observation):
        super().restore(env, observation)
        env.speed = 0


class Cut(Walk):
    """Truncates rounds itself."""

    def reset(self, **given):
        self.steps = 0
        return super().reset(**given)

    def step(self, action):
        self.steps += 1
        seen, reward, end, _, info = super().step(action)
        return seen, reward, end, self.steps == 3, info


class Arrived(Walk):
    def reset(self, *, seed=None, options=None):
        self.place = 10
        return np.array([10]), {}


class Dice(Wind):
    """Draws with a generator of its own."""

    def step(self, action):
        self.np_random = np.random.default_rng()
        return super().step(action)


class Named(Way):
    def terms(self, env, action, reward, terminated):
        return {"walked": reward}


class Cliff(Walk):
    """Who goes beyond the ninth step stays there and has fallen, which cannot be seen."""

    def reset(self, *, seed=None, options=None):
        self.fell = False
        return super().reset(seed=seed)

    def step(self, action):
        self.place += int(action)
        self.fell |= self.place > 9
        self.place = min(self.place, 9)
        return np.array([self.place]), 0.0, self.fell, False, {}


class Edge(Way):
    """The flag is restored, and observed as the place."""

    horizon = 12

    def make(self):
        return Cliff()

    def look(self, env):
        return {"ego": [env.place + env.fell], "visual": [[10 - env.place]]}

    def restore(self, env, observation):
        place = int(observation["ego"][0])
        env.place, env.fell = min(place, 9), place > 9

    def done(self, env):
        return env.fell


class Left(Edge):
    """Nothing is done about the flag."""

    def look(self, env):
        return {"ego": [env.place], "visual": [[10 - env.place]]}

    def restore(self, env, observation):
        env.place = min(int(observation["ego"][0]), 9)


class Cleared(Left):
    def restore(self, env, observation):
        super().restore(env, observation)
        env.fell = False


class Stuck(Edge):
    """The flag is observed, and not restored."""

    def restore(self, env, observation):
        env.place = min(int(observation["ego"][0]), 9)


class Old(Walk):
    def step(self, action):
        found, reward, end, _, info = super().step(action)
        return found, reward, end, info


def paid_by_chance(self, env, action, reward, terminated):
    return {"reward": env.np_random.random()}


def moved(state):
    return replace(state, values=state.values - torch.tensor([0.0, 1.0]))


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        (Forgetful, {}, "restore.. of the observation"),
        (Idle, {}, "restore.. of the observation"),
        (Left, {}, "done.. is True after restore.. of .*, expected False; restore.. does not set"),
        (Cleared, {}, "done.. is False after restore.. of .*, expected True"),
        (Stuck, {}, "done.. is True after restore.. of .*, expected False"),
        (
            Way,
            {"look": lambda self, env: {"ego": [np.nan], "visual": [[0.0]]}},
            r"look.. has \[nan, 0.0\], expected finite numbers",
        ),
        (Way, {"look": lambda self, env: None}, "look.. has None, expected a dict of arrays"),
        (
            Way,
            {"look": lambda self, env: {"ego": [np.random.rand()], "visual": [[0.0]]}},
            "look.. varies where nothing was done",
        ),
        (Way, {"make": lambda self: None}, "make.. has None, expected a gymnasium.Env"),
        (
            Way,
            {"done": lambda self, env: np.array([True, False])},
            r"done.. has .*\(2,\), expected True or False",
        ),
        (Way, {"terms": lambda self, *found: found[2]}, "terms.. has .*, expected reward"),
        (
            Way,
            {"terms": lambda self, *found: {"reward": np.ones(1)}},
            "terms.. has reward .*, expected numbers",
        ),
        (Way, {"make": lambda self: Old()}, "step.. of the environment has 4 values, expected obs"),
        (Way, {"make": lambda self: Random()}, "vary; restore.. does not set all"),
        (Way, {"make": lambda self: Wind()}, r"vary; .*steps are random \(then random = True"),
        (Windy, {"make": lambda self: Dice()}, "vary; .*another generator than np_random"),
        (Windy, {"redrawn": lambda self, state, generator: state}, "expected other seeds"),
        (
            Windy,
            {"redrawn": lambda self, state, generator: moved(state)},
            "redrawn: changes visual",
        ),
        (
            Unseen,
            {},
            r"step 1 after reset.seed=\d.: after \d, ego is .* but computed as .*restore..",
        ),
        (Way, {"make": lambda self: gym.wrappers.TimeLimit(Walk(), 4)}, "may be 4 at most"),
        (Way, {"make": lambda self: Cut()}, "may be 3 at most"),
        (Named, {}, "terms.. has walked, expected reward"),
        (Way, {"make": lambda self: Arrived()}, "done where rounds begin .seed"),
        (Endless, {"horizon": 12}, "but done.. says otherwise"),
        (Way, {"look": lambda self, env: {"ego": [0.0, 1.0], "visual": [[0.0]]}}, "look.. has ego"),
        (Way, {"moves": (0, 2)}, "the environment has 2 actions, from 0 on, and no 2"),
        (Swing, {"controls": (Control("torque", -3, 3),)}, "but the environment takes -2 to 2"),
        (Swing, {"controls": (Control("a"), Control("b"))}, "expected a Box of 2 numbers"),
    ],
)
def test_faults_of_environments_are_named(kind, changes, message):
    with pytest.raises(DomainError, match=message):
        world = type("Other", (kind,), changes)()
        found = faults_of(world)
        raise DomainError(found[0] if found else "nothing wrong")


def test_a_time_limit_may_be_the_horizon():
    kind = type("Limited", (Way,), {"make": lambda self: gym.wrappers.TimeLimit(Walk(), 6)})
    assert faults_of(kind()) == []


def test_steps_of_different_worlds_are_compared_in_tables_too():
    kind = type("Tabled", (GymnasiumWorld,), {**vars(Way), "random": False, "layouts": 8})
    assert faults_of(kind()) == []
    kind.terms = lambda self, env, action, reward, terminated: {"reward": reward, "more": 0.0}
    assert "terms() has reward, more, expected reward" in faults_of(kind())[0]


def test_a_flag_that_is_observed_and_restored_is_sound():
    assert faults_of(Edge()) == []


def test_what_a_world_needs_is_named():
    kind = type("Half", (Way,), {"restore": SteppedWorld.restore})
    with pytest.raises(DomainError, match="Half needs restore; see docs"):
        load_world(kind)


def test_remarks_say_whether_ends_were_checked():
    remark = remarks_on(Way())
    assert remark.startswith("random actions: rewards 0 to 1 a step; ")
    assert re.search(r"; [1-9]\d* of 100 rounds ended$", remark)
    assert remarks_on(Swing()).endswith("0 of 100 rounds ended, so ends were not checked")


def test_remarks_say_where_nothing_depends_on_chance():
    calm = type("Calm", (Way,), {"random": True})()
    assert "no step depended on chance, so random may be left out" in remarks_on(calm)
    assert "chance" not in remarks_on(Windy())
    unchecked = "recordings are not checked against what has to come next"
    assert unchecked in remarks_on(Windy()) and unchecked not in remarks_on(Way())
    paid = type("Paid", (Way,), {"random": True, "terms": paid_by_chance})()
    assert "chance" not in remarks_on(paid)


def test_controls_have_different_names():
    with pytest.raises(DomainError, match="controls need different names, found .'a', 'a'"):
        type("Twins", (Swing,), {"controls": (Control("a"), Control("a"))})()


def test_controls_outside_the_bounds_are_not_stepped():
    swing = Swing()
    state = swing.initial(1, torch.Generator().manual_seed(0))
    with pytest.raises(DomainError, match=r"controls are torque -2 to 2, not \[3.0\]"):
        swing.transition(state, torch.tensor([[3.0]]))
    number, control = swing.action_of(np.array([2.0001]))
    assert (number, control.tolist()) == (4, [2.0])  # within a thousandth of a level


def test_tables_are_for_numbered_actions():
    kind = type(
        "Tabulated",
        (GymnasiumWorld,),
        {
            name: part
            for name, part in vars(Swing).items()
            if name in ("modalities", "ego_features", "controls", "horizon", "make", "look")
        },
    )
    (fault,) = faults_of(kind())
    assert "has to be a SteppedWorld" in fault


class Pair(gym.Env):
    """Two numbers; the second control of zeros has the bytes of the first action."""

    observation_space = gym.spaces.Box(-9, 9, (2,))
    action_space = gym.spaces.Box(-2, 2, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = np.ones(2, np.float32)
        return self.place, {}

    def step(self, action):
        self.place += action  # in place: what the world gives must not be its own memory
        return self.place, 0.0, False, False, {}


class Two(SteppedWorld):
    modalities = (Modality("visual", ("place",), ("x", "y"), ("m", "m"), (9.0, 9.0), 0.01),)
    ego_features = ("nothing",)
    controls = (Control("x", -2, 2), Control("y", -2, 2))
    horizon = 2

    def make(self):
        return Pair()

    def look(self, env):
        return {"ego": [0.0], "visual": [env.place]}

    def restore(self, env, observation):
        env.place = observation["visual"][0]


def test_an_action_and_control_values_of_the_same_bytes_are_told_apart():
    two = Two()
    assert faults_of(two) == []
    state = two.initial(1, torch.Generator().manual_seed(0))
    low = two.transition(state, torch.tensor([0]))
    still = two.transition(state, torch.zeros(1, 2))
    assert two.observe(low)["visual"].tolist() == [[[-1.0, -1.0]]]
    assert two.observe(still)["visual"].tolist() == [[[1.0, 1.0]]]


def test_no_states_lead_to_none():
    way = Way()
    none = way.state_behind({"ego": torch.zeros(0, 1), "visual": torch.zeros(0, 1, 1)})
    following = way.transition(none, torch.zeros(0, dtype=torch.long))
    assert following.values.shape == (0, 2) and following.done.dtype == torch.bool

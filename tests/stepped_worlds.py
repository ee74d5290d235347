"""Worlds that are stepped: a walk of ten steps, without and with wind, and a pendulum."""

import gymnasium as gym
import numpy as np

from mirror_ppl.domains import Control, Modality
from mirror_ppl.domains.stepped_world import SteppedWorld


class Walk(gym.Env):
    """Ten steps to the right, and the walk is over."""

    observation_space = gym.spaces.Box(0, 20, (1,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = int(self.np_random.integers(8))
        return np.array([self.place]), {}

    def step(self, action):
        self.place += int(action)
        return np.array([self.place]), float(action), self.place >= 10, False, {}


class Way(SteppedWorld):
    modalities = (Modality("visual", ("end",), ("offset",), ("m",), (10.0,), 0.01),)
    ego_features = ("place",)
    actions = ("stay", "go")
    horizon = 6
    positions = ("offset",)

    def make(self):
        return Walk()

    def look(self, env):
        return {"ego": [env.place], "visual": [[10 - env.place]]}

    def restore(self, env, observation):
        env.place = int(observation["ego"][0])

    def done(self, env):
        return env.place >= 10


class Wind(Walk):
    """Who goes gets up to three steps farther."""

    def step(self, action):
        return super().step(int(action) * self.np_random.integers(1, 4))


class Random(Walk):
    def step(self, action):
        self.place += int(self.np_random.integers(5))
        return np.array([self.place]), 0.0, self.place >= 10, False, {}


class Windy(Way):
    random = True

    def make(self):
        return Wind()


class Endless(Way):
    def done(self, env):
        return False


class Swing(SteppedWorld):
    """Gymnasium's pendulum; who looks sees where its end is."""

    modalities = (Modality("visual", ("end",), ("up", "right"), ("m", "m"), (1.0, 1.0), 0.01),)
    ego_features = ("speed",)
    controls = (Control("torque", -2, 2, 5, "Nm"),)
    horizon = 5
    reach_bins = (0.0, 1.0)
    positions = ("up", "right")

    def make(self):
        return gym.make("Pendulum-v1")

    def look(self, env):
        angle, speed = env.state
        return {"ego": [speed], "visual": [[np.cos(angle), np.sin(angle)]]}

    def restore(self, env, observation):
        up, right = observation["visual"][0].astype(float)
        env.state = np.array([np.arctan2(right, up), float(observation["ego"][0])])

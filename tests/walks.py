"""A walk of ten steps as a Gymnasium environment and a world, without and with wind."""

import gymnasium as gym
import numpy as np

from mirror_ppl.domains import Modality
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


class Windy(Way):
    random = True

    def make(self):
        return Wind()

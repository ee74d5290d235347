"""A drone that a person flies by joystick: Gymnasium with continuous actions."""

import gymnasium
import numpy as np

from mirror_ppl.domains import Control, Modality, Record
from mirror_ppl.domains.stepped_world import SteppedWorld

NEAR = 1.0  # metres


class Drone(gymnasium.Env):
    """Fly to a pad, and around a tree on the way to it."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,))
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (2,))  # metres ahead, to the right

    def reset(self, *, seed=None, options=None):
        """Begin with the pad 2 to 6 metres away, and the tree about half way."""
        super().reset(seed=seed)
        angle, far = self.np_random.uniform((-np.pi, 2), (np.pi, 6))
        self.pad = far * np.array([np.cos(angle), np.sin(angle)])
        self.tree = self.pad / 2 + self.np_random.uniform(-0.7, 0.7, 2)
        return np.concatenate([self.pad, self.tree]), {}

    def step(self, action):
        """Fly; both places move the other way."""
        self.pad, self.tree = self.pad - action, self.tree - action
        landed = bool(np.hypot(*self.pad) < NEAR)
        reward = 4.0 * landed - 3.0 * (np.hypot(*self.tree) < NEAR) - 0.2
        return np.concatenate([self.pad, self.tree]), float(reward), landed, False, {}


class Delivery(SteppedWorld):
    """The drone's pilot sees what is near; in fog, very near."""

    modalities = (
        Modality("visual", ("pad", "tree"), ("ahead", "right"), ("m",) * 2, (12.0, 12.0), 0.01),
    )
    ego_features = ("landed",)
    controls = (Control("ahead", -2, 2, 3, "m"), Control("right", -2, 2, 3, "m"))
    horizon = 8
    settings = ("clear", "fog")
    positions = ("ahead", "right")
    reach_bins = (0.0, 1.0, 2.0, 4.0, 24.0)
    record = Record(
        networks={"encoder": 128, "decoder": 64, "q_network": 200},
        training={
            "phases": 80,
            "rounds": 200,
            "steps": 80,
            "stride": 2,
            "learning_rate": 2e-3,
            "world_weight": 0.003,
            "difference_weight": 1.0,
            "at_means": True,
            "kinds": (0.3, 0.1, 0.6),
        },
    )

    def make(self):
        """The environment."""
        return Drone()

    def look(self, env):
        """Where pad and tree are, from the drone."""
        return {"ego": [self.done(env)], "visual": [env.pad, env.tree]}

    def restore(self, env, observation):
        """Put pad and tree where they were observed."""
        env.pad, env.tree = observation["visual"].astype(float)

    def done(self, env):
        """Delivered."""
        return bool(np.hypot(*env.pad) < NEAR)

    def visibility(self, setting, observation):
        """In fog what is at most 2 metres ahead or behind, and at most 2 to the side."""
        _, distance = self.distance(observation)
        return {"visual": (distance <= 2) | (setting == "clear")}

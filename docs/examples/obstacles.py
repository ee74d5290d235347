"""Balls that roll at random between a person and the goal: a random world of MiniGrid."""

import numpy as np
from minigrid.envs import DynamicObstaclesEnv

from mirror_ppl.domains import Modality, Record
from mirror_ppl.domains.stepped_world import SteppedWorld

SIZE, BALLS = 7, 3
GOAL = (SIZE - 2, SIZE - 2)


class Room(DynamicObstaclesEnv):
    """Remembers whether the person ran into something, which ends the round."""

    def reset(self, **given):
        """Begin anywhere."""
        self.crashed = False
        found = super().reset(**given)
        self.bare = [None if cell in self.obstacles else cell for cell in self.grid.grid]
        return found

    def step(self, action):
        """Take a step; balls roll to a neighbouring cell."""
        found = super().step(action)
        self.crashed |= found[1] < 0
        return found

    def gen_obs(self):
        """No picture, which takes longer than the rest of a step."""
        return {}


class Obstacles(SteppedWorld):
    """People see balls within a few cells, and always the goal."""

    random = True
    modalities = (
        Modality(
            "visual",
            tuple(f"ball {number}" for number in range(1, BALLS + 1)),
            ("ahead", "right"),
            ("cells", "cells"),
            (SIZE - 2.0,) * 2,
            0.01,
        ),
    )
    ego_features = ("goal ahead", "goal right", "column", "row", "direction", "over")
    actions = ("turn left", "turn right", "go ahead")
    levels = {
        **dict.fromkeys(("ahead", "right", "goal ahead", "goal right"), range(3 - SIZE, SIZE - 2)),
        **dict.fromkeys(("column", "row"), range(1, SIZE - 1)),
        "direction": range(4),
        "over": range(2),
    }
    horizon = 20
    settings = ("bright", "dim")
    positions = ("ahead", "right")
    reach_bins = (0.0, 1.0, 2.0, 3.0, 5.0)
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
        return Room(size=SIZE, n_obstacles=BALLS, agent_start_pos=None)

    def look(self, env):
        """Where goal and balls are, from the person."""

        def offset(place):
            away = np.array(place) - env.agent_pos
            return [int(away @ env.dir_vec), int(away @ env.right_vec)]

        ego = [*offset(GOAL), *env.agent_pos, env.agent_dir, self.done(env)]
        return {"ego": ego, "visual": [offset(ball.cur_pos) for ball in env.obstacles]}

    def restore(self, env, observation):
        """Put all things where they were observed."""
        *_, column, row, direction, over = observation["ego"].astype(int)
        env.agent_pos, env.agent_dir = np.array([column, row]), direction
        env.step_count, env.crashed = 0, bool(over) and (column, row) != GOAL
        env.grid.grid = list(env.bare)
        places = observation["visual"].astype(int) @ np.array([env.dir_vec, env.right_vec])
        for ball, place in zip(env.obstacles, env.agent_pos + places, strict=True):
            env.put_obj(ball, *place)

    def done(self, env):
        """At the goal, or crashed."""
        return env.crashed or tuple(env.agent_pos) == GOAL

    def terms(self, env, action, reward, terminated):
        """The goal is worth 4, a crash costs 3, a step a tenth."""
        return {"reward": 4.0 * (reward > 0) - 3.0 * (reward < 0) - 0.1}

    def visibility(self, setting, observation):
        """In the dim what is next to oneself."""
        _, distance = self.distance(observation)
        return {"visual": (distance <= 1) | (setting == "bright")}

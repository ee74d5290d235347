"""Two rooms, a locked door, a key and a goal: MiniGrid, seen by people of limited sight."""

import torch
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Door, Goal, Key
from minigrid.minigrid_env import MiniGridEnv

from mirror_ppl.domains import Modality, Record
from mirror_ppl.domains.gymnasium_world import GymnasiumWorld

WIDTH, HEIGHT, WALL, DOOR_ROW = 7, 6, 4, 2


class TwoRooms(MiniGridEnv):
    """The key lies in the left room, behind whose door the right one is; the goal in any."""

    def __init__(self):
        super().__init__(
            mission_space=MissionSpace(mission_func=lambda: "reach the goal"),
            width=WIDTH,
            height=HEIGHT,
            max_steps=10**6,
        )

    def _gen_grid(self, width, height):
        self.grid = Grid(width, height)
        self.grid.wall_rect(0, 0, width, height)
        self.grid.vert_wall(WALL, 0)
        self.put_obj(Door("yellow", is_locked=True), WALL, DOOR_ROW)
        left = {"top": (1, 1), "size": (WALL - 1, height - 2)}
        self.place_obj(Key("yellow"), **left)
        self.place_obj(Goal())
        self.place_agent(**left)
        self.mission = "reach the goal"

    def __getstate__(self):
        """Without what belongs to Gymnasium alone, and cannot be copied or need not be."""
        left_out = ("observation_space", "action_space", "mission_space", "_np_random", "spec")
        return {name: part for name, part in vars(self).items() if name not in left_out}


class Unlocking(GymnasiumWorld):
    """Reach the goal; behind the door only with the key."""

    modalities = (
        Modality("visual", ("key", "goal"), ("ahead", "right"), ("cells",) * 2, (4.0, 4.0), 0.01),
    )
    ego_features = ("row", "column", "heading", "has_key", "door_open")
    actions = ("turn left", "turn right", "go ahead", "pick up", "use the door")
    moves = (0, 1, 2, 3, 5)
    layouts = 60
    horizon = 24
    settings = ("bright", "dim")
    reward_terms = ("goal", "step")
    positions = ("ahead", "right")
    directions = ("here", "beyond")
    direction_groups = ((0,), (1,))
    levels = {
        "row": range(HEIGHT),
        "column": range(WIDTH),
        "heading": range(4),
        "has_key": range(2),
        "door_open": range(2),
        "ahead": range(-4, 5),
        "right": range(-4, 5),
    }
    reach_bins = (0.0, 1.0, 2.0, 3.0, 4.0)
    reach_unit = "cells"
    lasting = ("key", "goal")
    record = Record(
        networks={"encoder": 128, "decoder": 64, "q_network": 200},
        training={
            "phases": 300,
            "rounds": 200,
            "steps": 40,
            "learning_rate": 2e-3,
            "beta": 1.0,
            "beta_decay": 0.98,
            "discount": 0.95,
            "length": 12,
            "stride": 2,
            "difference_weight": 4.0,
            "exact": True,
        },
    )

    def make(self):
        """MiniGrid with the two rooms."""
        return TwoRooms()

    def begins(self, env):
        """Anywhere in the left room, before anything was done."""
        return env.carrying is None and env.grid.get(WALL, DOOR_ROW).is_locked

    def look(self, env):
        """Key and goal by how far they are ahead, and to the right, of the person."""
        column, row = (int(part) for part in env.agent_pos)
        (across, down), places = env.dir_vec, {"Key": (0, 0)}  # in their hands
        for place, thing in enumerate(env.grid.grid):
            x, y = place % WIDTH - column, place // WIDTH - row
            if thing is not None:
                places[type(thing).__name__] = (x * across + y * down, y * across - x * down)
        door = env.grid.get(WALL, DOOR_ROW)
        ego = (row, column, int(env.agent_dir), env.carrying is not None, door.is_open)
        return {"ego": [float(part) for part in ego], "visual": [places["Key"], places["Goal"]]}

    def terms(self, env, action, reward, terminated):
        """In units of reward: the goal is worth six, each step costs a tenth."""
        return {"goal": 6.0 * (terminated and reward > 0), "step": -0.1}

    def distance(self, observation):
        """Things in the same room, and beyond the wall."""
        _, far = super().distance(observation)
        column, heading = observation["ego"][..., 1:2], observation["ego"][..., 2:3].long()
        across, down = (torch.tensor(part)[heading] for part in ((1, 0, -1, 0), (0, 1, 0, -1)))
        ahead, right = observation["visual"].unbind(-1)
        thing = column + ahead * across - right * down
        return ((column > WALL) != (thing > WALL)).long(), far

    def visibility(self, setting, observation):
        """In dim light what is near, and nothing beyond the wall."""
        direction, far = self.distance(observation)
        return {"visual": ((direction == 0) & (far <= 1)) | torch.tensor(setting == "bright")}

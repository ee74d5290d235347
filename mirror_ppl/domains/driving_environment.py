"""The driving domain as a Gymnasium environment, one round at a time."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import InvalidAction, ResetNeeded

from mirror_ppl.domains.base import require_known, total_reward
from mirror_ppl.domains.driving import ROAD_END, Driving, DrivingState

RENDER_MODES = ("rgb_array",)

EnvObservation = dict[str, Any]
"""Numpy arrays by name."""


class DrivingEnv(gymnasium.Env[EnvObservation, np.int64]):
    """Two lanes, four cars that never yield, and what one person sees of them.

    ## Description
    A round of `mirror_ppl.domains.driving.Driving`, seen by an unaided person in one of the
    domain's settings. All mechanics are the domain's: this class only draws the round, hides what
    the setting hides and counts steps.

    ## Action Space
    `Discrete(2)`: 0 stays in the lane, 1 is in the other lane at the next step.

    ## Observation Space
    A `Dict`; cars are in the order front-left, front-right, rear-left, rear-right, named by where
    they start. A masked value is 0.

    | key           | shape  | type    | feature           | unit       | range     |
    |---------------|--------|---------|-------------------|------------|-----------|
    | `ego`         | (1,)   | float32 | lane of the ego   | index      | 0 or 1    |
    | `visual`      | (4, 2) | float32 | distance ahead    | cells      | -12 to 12 |
    |               |        |         | lane offset       | lanes      | -1 to 1   |
    | `visual_mask` | (4,)   | int8    | the car is seen   |            | 0 or 1    |
    | `verbal`      | (4, 3) | float32 | distance ahead    | cells      | -12 to 12 |
    |               |        |         | lane offset       | lanes      | -1 to 1   |
    |               |        |         | relative speed    | cells/step | -1 to 1   |
    | `verbal_mask` | (4,)   | int8    | the car is told   |            | 0 or 1    |

    Nobody speaks in this environment, so that the verbal part is always masked; it is there to have
    the layout of the domain's observations.

    `info` holds the `scenario`'s name and, in `state`, the true `lane`, `position` (cells ahead,
    not saturated) and `speed` (cells/step); after a step also the `rewards`, terms by name.

    ## Rewards
    The sum of the domain's terms, of the action and the state that it leads to: `proximity` (-2 for
    each car of the ego's lane at most two cells away), `collision` (-5 for each car in the ego's
    cell), `off_road` (-5, never met with these actions) and `lane_change` (-1).

    ## Starting State
    A random lane, cars at random distances of 1 to 11 cells, and a random scenario unless one is
    given.

    ## Episode End
    Truncated after 15 steps; never terminated.

    ## Arguments
    `setting` ("clear" or "fog"), `scenario` (a name among `Driving.scenarios`, or None for a random
    one in each round) and `render_mode` ("rgb_array" or None):
    `gymnasium.make("mirror_ppl/Driving-v0", setting="fog")`.

    ## Version History
    * v0: first version.

    Raises:
        UnknownNameError: if the setting, the scenario or the render mode is not a known one.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": 4}

    def __init__(
        self,
        setting: str = "clear",
        scenario: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.domain = Driving()
        self.setting = require_known(setting, "setting", self.domain.settings)
        if scenario is not None:
            require_known(scenario, "scenario", self.domain.scenarios)
        self.scenario = scenario
        if render_mode is not None:
            require_known(render_mode, "render mode", RENDER_MODES)
        self.render_mode = render_mode

        self.action_space = spaces.Discrete(len(self.domain.actions))
        self.observation_space = _observation_space(self.domain)
        self._state: DrivingState | None = None
        self._scenario_name = ""
        self._step = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[EnvObservation, dict[str, Any]]:
        """Start a round; the same seed gives the same round. There are no ``options``."""
        super().reset(seed=seed, options=options)
        scenarios = self.domain.scenarios
        if self.scenario is None:
            index = int(self.np_random.integers(len(scenarios)))
        else:
            index = scenarios.index(self.scenario)
        # The domain draws from torch's generators; this one hangs on Gymnasium's seed.
        generator = torch.Generator().manual_seed(int(self.np_random.integers(2**63 - 1)))
        self._state = _only(self.domain.initial(1, generator, torch.tensor([index])))
        self._scenario_name = scenarios[index]
        self._step = 0
        return self._observation(self._state), self._info(self._state)

    def step(self, action: np.int64) -> tuple[EnvObservation, float, bool, bool, dict[str, Any]]:
        """Play one step; see `gymnasium.Env.step`.

        Raises:
            ResetNeeded: before the first reset, and after the last step of a round.
            InvalidAction: if the action is not 0 or 1.
        """
        if self._state is None or self._step == self.domain.horizon:
            raise ResetNeeded("call reset() to start a round")
        if not self.action_space.contains(action):
            raise InvalidAction(f"expected an action of {self.action_space}, given {action!r}")
        chosen = torch.tensor(int(action))
        following = self.domain.transition(self._state, chosen)
        terms = self.domain.rewards(self._state, chosen, following)
        self._state = following
        self._step += 1
        info = self._info(following)
        # Adding zero turns the -0.0 of a penalty that does not apply into 0.0.
        info["rewards"] = {name: term.item() + 0.0 for name, term in terms.items()}
        reward = total_reward(terms).item() + 0.0
        truncated = self._step == self.domain.horizon
        return self._observation(following), reward, False, truncated, info

    def render(self) -> np.ndarray | None:
        """Picture ``uint8 [height, width, 3]`` of everything on the road, seen or not.

        Returns:
            The picture, or None if the environment was made without a render mode.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('make the environment with render_mode="rgb_array" to render it')
            return None
        if self._state is None:
            raise ResetNeeded("call reset() to start a round")
        return self.domain.render(self._state)

    def _observation(self, state: DrivingState) -> EnvObservation:
        """What the person sees of a state, as numpy arrays of their own."""
        values = self.domain.observe(state)
        masks = self.domain.visibility(self.setting, values)
        seen: EnvObservation = {"ego": values["ego"].numpy().astype(np.float32)}
        for name, mask in masks.items():
            shown = torch.where(mask[..., None], values[name], 0.0)
            seen[name] = shown.numpy().astype(np.float32)
            seen[f"{name}_mask"] = mask.numpy().astype(np.int8)
        return seen

    def _info(self, state: DrivingState) -> dict[str, Any]:
        return {
            "scenario": self._scenario_name,
            "state": {
                "lane": int(state.lane),
                "position": state.position.numpy().copy(),
                "speed": state.speed.numpy().copy(),
            },
        }


def _observation_space(domain: Driving) -> spaces.Dict:
    parts: dict[str, spaces.Space[Any]] = {"ego": spaces.Box(0.0, 1.0, (1,), np.float32)}
    # Distance ahead, lane offset, relative speed; a modality has the first of them that it names.
    limits = np.array([ROAD_END, 1, 1], dtype=np.float32)
    for modality in domain.modalities:
        shape = (len(modality.items), len(modality.features))
        high = np.broadcast_to(limits[: shape[1]], shape)
        parts[modality.name] = spaces.Box(-high, high, dtype=np.float32)
        parts[f"{modality.name}_mask"] = spaces.MultiBinary(shape[0])
    return spaces.Dict(parts)


def _only(states: DrivingState) -> DrivingState:
    """The state in a batch of one."""
    return DrivingState(states.lane[0], states.position[0], states.speed[0])

"""Rounds of highway driving for Gymnasium, whatever simulator moves the vehicles."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import InvalidAction, ResetNeeded

from mirror_ppl.domains.base import require_known, total_reward
from mirror_ppl.domains.environment import RENDER_MODES, EnvObservation
from mirror_ppl.domains.highway.lidar import RANGE, SECTORS
from mirror_ppl.domains.highway.road import LANES, TICK, TICKS
from mirror_ppl.domains.highway.speech import DIRECTIONS, NOTHING
from mirror_ppl.domains.highway.state import HighwayState
from mirror_ppl.domains.highway.world import Highway

FASTEST = 60.0
"""m/s that no relative velocity exceeds."""


class RoundEnv(gymnasium.Env[EnvObservation, np.ndarray]):
    """One round at a time: spaces, what is seen, rewards and ends.

    A subclass has the simulator: `begin` starts a round in it, `advance` plays a decision, and
    `simulated` says what its state is now.

    Args:
        setting: one of the domain's settings; the first unless given.
        scenario: a name among its scenarios, or None for a random one in each round.
        render_mode: "rgb_array" or None.

    Raises:
        UnknownNameError: if the setting, the scenario or the render mode is not a known one.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": list(RENDER_MODES),
        "render_fps": round(1 / (TICK * TICKS)),
    }
    domain: ClassVar[Highway] = Highway()

    def __init__(
        self,
        setting: str | None = None,
        scenario: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        domain = self.domain
        self.setting = require_known(
            setting or domain.settings[0], "setting", domain.settings, domain.name
        )
        if scenario is not None:
            require_known(scenario, "scenario", domain.scenarios, domain.name)
        self.scenario = scenario
        if render_mode is not None:
            require_known(render_mode, "render mode", RENDER_MODES)
        self.render_mode = render_mode
        self.action_space = spaces.Box(-1.0, 1.0, (len(domain.actions),), np.float32)
        self.observation_space = _observation_space()
        self._now: HighwayState | None = None
        self._scenario_name = ""
        self._step = 0

    @abstractmethod
    def begin(self, scenario: int, seed: int) -> None:
        """Start a round of a scenario, given by its index, with a seed for all chance."""

    @abstractmethod
    def advance(self, action: np.ndarray) -> None:
        """Play a decision: steering and acceleration ``[2]`` in [-1, 1]."""

    @abstractmethod
    def simulated(self) -> HighwayState:
        """Return the simulator's state now, without batch."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[EnvObservation, dict[str, Any]]:
        """Start a round; the same seed gives the same round. ``options`` are not used."""
        super().reset(seed=seed, options=options)
        scenarios = self.domain.scenarios
        if self.scenario is None:
            index = int(self.np_random.integers(len(scenarios)))
        else:
            index = scenarios.index(self.scenario)
        self.begin(index, int(self.np_random.integers(2**31 - 1)))
        self._now, self._scenario_name, self._step = self.simulated(), scenarios[index], 0
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[EnvObservation, float, bool, bool, dict[str, Any]]:
        """Play one step; see `gymnasium.Env.step`.

        Raises:
            ResetNeeded: before the first reset, and after the last step of a round.
            InvalidAction: if the action is no array of two numbers in [-1, 1].
        """
        before = self.state
        if self._step == self.domain.horizon or before.over:
            raise ResetNeeded("call reset() to start a round")
        chosen = np.array(action, np.float32) if np.shape(action) == (2,) else None
        if chosen is None or not self.action_space.contains(chosen):
            raise InvalidAction(f"expected an action of {self.action_space}, given {action!r}")
        self.advance(chosen)
        self._step += 1
        after = self._now = self.simulated()
        terms = self.domain.rewards(before, torch.from_numpy(chosen), after)
        info = self._info()
        # Adding zero turns the -0.0 of a penalty that does not apply into 0.0.
        info["rewards"] = {name: term.item() + 0.0 for name, term in terms.items()}
        reward = total_reward(terms).item() + 0.0
        terminated = bool(after.over)
        truncated = self._step == self.domain.horizon and not terminated
        return self._observation(), reward, terminated, truncated, info

    @property
    def state(self) -> HighwayState:
        """The true state, without batch, as the domain's functions take it.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self._now is None:
            raise ResetNeeded("call reset() to start a round")
        return self._now

    def render(self) -> np.ndarray | None:
        """Return a picture ``uint8 [height, width, 3]``; sectors that are not seen are grey.

        Returns:
            The picture, or None if the environment was made without a render mode.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('make the environment with render_mode="rgb_array" to render it')
            return None
        return self.domain.render(self.state, self.setting)

    def _observation(self) -> EnvObservation:
        """Return what the person sees, as new numpy arrays."""
        values = self.domain.observe(self.state)
        masks = self.domain.visibility(self.setting, values)
        seen: EnvObservation = {"ego": values["ego"].numpy().astype(np.float32)}
        for name, mask in masks.items():
            shown = torch.where(mask[..., None], values[name], 0.0)
            seen[name] = shown.numpy().astype(np.float32)
            seen[f"{name}_mask"] = mask.numpy().astype(np.int8)
        return seen

    def _info(self) -> dict[str, Any]:
        parts = {
            name: part.numpy().copy() if part.dim() else part.item()
            for name, part in vars(self.state).items()
        }
        return {"scenario": self._scenario_name, "state": parts}


def _observation_space() -> spaces.Dict:
    def box(low: list[float], high: list[float], *shape: int) -> spaces.Box:
        least, most = (np.broadcast_to(np.array(each, np.float32), shape) for each in (low, high))
        return spaces.Box(least, most, dtype=np.float32)

    ego = [(0.0, LANES - 1.0), (-10.0, 10.0), (-np.pi, np.pi), (-1.0, 20.0), (-1, 1), (-1, 1)]
    low, high = (list(each) for each in zip(*ego, strict=True))
    directions = len(DIRECTIONS)
    return spaces.Dict(
        {
            "ego": box(low, high, len(ego)),
            "visual": box([0.0, -FASTEST, -FASTEST], [RANGE, FASTEST, FASTEST], SECTORS, 3),
            "visual_mask": spaces.MultiBinary(SECTORS),
            "verbal": box([0.0], [float(NOTHING)], directions, 1),
            "verbal_mask": spaces.MultiBinary(directions),
        }
    )

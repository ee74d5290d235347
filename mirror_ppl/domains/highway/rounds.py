"""Rounds of highway driving for Gymnasium, whatever simulator moves the vehicles."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from mirror_ppl.domains.environment import RENDER_MODES, DomainEnv
from mirror_ppl.domains.highway.limits import LIMITS
from mirror_ppl.domains.highway.road import TICK, TICKS
from mirror_ppl.domains.highway.state import HighwayState
from mirror_ppl.domains.highway.world import DirectHighway


class RoundEnv(DomainEnv):
    """Rounds with steering and acceleration as actions.

    A subclass has the simulator: `begin` starts a round in it, `advance` plays a decision, and
    `simulated` says what its state is now.

    Args:
        setting: one of the domain's settings; the first unless given.
        scenario: a name among its scenarios, or None for a random one in each round.
        render_mode: "rgb_array" or None. Sectors that are not seen are grey.

    Raises:
        UnknownNameError: if the setting, the scenario or the render mode is not a known one.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": list(RENDER_MODES),
        "render_fps": round(1 / (TICK * TICKS)),
    }
    domain: ClassVar[Any] = DirectHighway()
    limits: ClassVar[Mapping[str, tuple[list[float], list[float]]]] = LIMITS

    @abstractmethod
    def begin(self, scenario: int, seed: int) -> None:
        """Start a round of a scenario, given by its index, with a seed for all chance."""

    @abstractmethod
    def advance(self, action: np.ndarray) -> None:
        """Play a decision: steering and acceleration ``[2]`` in [-1, 1]."""

    @abstractmethod
    def simulated(self) -> HighwayState:
        """Return the simulator's state now, without batch."""

    def _actions(self) -> spaces.Space[Any]:
        return spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _checked(self, action: Any) -> Tensor | None:
        if np.shape(action) != self.action_space.shape:
            return None
        chosen = np.array(action, np.float32)
        return torch.from_numpy(chosen) if self.action_space.contains(chosen) else None

    def _begin(self, scenario: int, seed: int) -> HighwayState:
        self.begin(scenario, seed)
        return self.simulated()

    def _advance(self, state: HighwayState, action: Tensor) -> HighwayState:
        self.advance(action.numpy())
        return self.simulated()

    def _picture(self, state: HighwayState) -> np.ndarray:
        return self.domain.render(state, self.setting)

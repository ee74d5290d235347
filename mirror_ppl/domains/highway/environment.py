"""Highway driving as a Gymnasium environment on highway-env, one round at a time."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import InvalidAction, ResetNeeded

from mirror_ppl.domains.base import map_state, require_known, total_reward
from mirror_ppl.domains.environment import RENDER_MODES, EnvObservation
from mirror_ppl.domains.highway import vehicles
from mirror_ppl.domains.highway.lidar import RANGE, SECTORS
from mirror_ppl.domains.highway.road import LANES, TICK, TICKS
from mirror_ppl.domains.highway.speech import DIRECTIONS, NOTHING
from mirror_ppl.domains.highway.state import HighwayState
from mirror_ppl.domains.highway.world import Highway

FASTEST = 60.0
"""m/s that no relative velocity exceeds."""


class HighwayEnv(gymnasium.Env[EnvObservation, np.ndarray]):
    """Three lanes, traffic with one manoeuvre that calls for a response, and lidar.

    ## Description
    A round of `mirror_ppl.domains.highway.Highway`, seen by an unaided person in one of its
    settings. Vehicles are highway-env's and move by its physics; observations and rewards are the
    domain's. The domain's own batched physics agrees with it, which tests compare.

    ## Action Space
    `Box(-1, 1, (2,))`, for 0.2 s.

    | number | action       | at 1                               | at -1                |
    |--------|--------------|------------------------------------|----------------------|
    | 0      | steering     | 0.2 rad at the wheels to the right | 0.2 rad to the left  |
    | 1      | acceleration | 5 m/s2                             | braking with 5 m/s2  |

    ## Observation Space
    A `Dict`. A masked value is 0.

    | key           | shape   | type    | feature                    | unit  | range      |
    |---------------|---------|---------|----------------------------|-------|------------|
    | `ego`         | (6,)    | float32 | lane                       | index | 0 to 2     |
    |               |         |         | lane offset, to the right  | m     | -10 to 10  |
    |               |         |         | heading, clockwise         | rad   | -pi to pi  |
    |               |         |         | speed                      | m/s   | -1 to 20   |
    |               |         |         | last steering              | share | -1 to 1    |
    |               |         |         | last acceleration          | share | -1 to 1    |
    | `visual`      | (36, 3) | float32 | distance                   | m     | 0 to 60    |
    |               |         |         | relative velocity along    | m/s   | -60 to 60  |
    |               |         |         | relative velocity across   | m/s   | -60 to 60  |
    | `visual_mask` | (36,)   | int8    | the sector is seen         |       | 0 or 1     |
    | `verbal`      | (6, 1)  | float32 | sentence about a direction | index | 0 to 5     |
    | `verbal_mask` | (6,)    | int8    | it was said                |       | 0 or 1     |

    Sector *k* of `visual` looks 10 *k* degrees clockwise from the heading. This environment has no
    messages, so the verbal part is always masked; it is included to keep the layout of the domain's
    observations.

    `info` holds the `scenario`'s name and, in `state`, the fields of the true
    `mirror_ppl.domains.highway.HighwayState`; after a step also the `rewards`, terms by name.

    ## Rewards
    The sum of the terms of `mirror_ppl.domains.highway.reward`.

    ## Starting State
    The domain's `initial`: a random scenario unless one is given.

    ## Episode End
    Terminated by a collision of the ego, and when its centre leaves the shoulder. Truncated after
    120 steps (24 s).

    ## Arguments
    `setting` ("clear" or "fog"), `scenario` (a name among `Highway.scenarios`, or None for a random
    one in each round) and `render_mode` ("rgb_array" or None):
    `gymnasium.make("mirror_ppl/Highway-v0", setting="fog")`.

    ## Version History
    * v0: first version.

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
        self._road: vehicles.Road | None = None
        self._controls = np.zeros(2)
        self._scenario_name = ""
        self._tick = self._step = 0

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
        # The domain draws from torch's generators; this one depends on Gymnasium's seed.
        generator = torch.Generator().manual_seed(int(self.np_random.integers(2**63 - 1)))
        batch = self.domain.initial(1, generator, torch.tensor([index]))
        self._road = vehicles.make_road(map_state(lambda part: part[0], batch))
        self._controls = np.zeros(2)
        self._scenario_name = scenarios[index]
        self._tick = self._step = 0
        now = self.state
        return self._observation(now), self._info(now)

    def step(self, action: np.ndarray) -> tuple[EnvObservation, float, bool, bool, dict[str, Any]]:
        """Play one step; see `gymnasium.Env.step`.

        Raises:
            ResetNeeded: before the first reset, and after the last step of a round.
            InvalidAction: if the action is no array of two numbers in [-1, 1].
        """
        if self._road is None or self._ended(self.state):
            raise ResetNeeded("call reset() to start a round")
        chosen = np.asarray(action, np.float32) if np.shape(action) == (2,) else None
        if chosen is None or not self.action_space.contains(chosen):
            raise InvalidAction(f"expected an action of {self.action_space}, given {action!r}")
        before = self.state
        self._controls = chosen.astype(np.float64)
        ego = vehicles.ego_of(self._road)
        ego.drive(self._controls)
        for _ in range(TICKS):
            if not ego.hit_others:
                vehicles.tick(self._road, self._tick)
                self._tick += 1
        self._step += 1
        after = self.state
        terms = self.domain.rewards(before, torch.from_numpy(chosen.copy()), after)
        info = self._info(after)
        # Adding zero turns the -0.0 of a penalty that does not apply into 0.0.
        info["rewards"] = {name: term.item() + 0.0 for name, term in terms.items()}
        reward = total_reward(terms).item() + 0.0
        terminated = bool(self.domain.over(after))
        truncated = self._step == self.domain.horizon and not terminated
        return self._observation(after), reward, terminated, truncated, info

    @property
    def state(self) -> HighwayState:
        """The true state, without batch, as the domain's functions take it.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self._road is None:
            raise ResetNeeded("call reset() to start a round")
        return vehicles.read_road(self._road, self._tick, self._controls)

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

    def _ended(self, state: HighwayState) -> bool:
        return self._step == self.domain.horizon or bool(self.domain.over(state))

    def _observation(self, state: HighwayState) -> EnvObservation:
        """Return what the person sees, as new numpy arrays."""
        values = self.domain.observe(state)
        masks = self.domain.visibility(self.setting, values)
        seen: EnvObservation = {"ego": values["ego"].numpy().astype(np.float32)}
        for name, mask in masks.items():
            shown = torch.where(mask[..., None], values[name], 0.0)
            seen[name] = shown.numpy().astype(np.float32)
            seen[f"{name}_mask"] = mask.numpy().astype(np.int8)
        return seen

    def _info(self, state: HighwayState) -> dict[str, Any]:
        parts = {
            name: part.numpy().copy() if part.dim() else part.item()
            for name, part in vars(state).items()
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

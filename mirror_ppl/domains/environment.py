"""Domains as Gymnasium environments, one round at a time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import InvalidAction, ResetNeeded
from torch import Tensor

from mirror_ppl.domains.base import Domain, map_state, require_known, total_reward

RENDER_MODES = ("rgb_array",)

EnvObservation = dict[str, Any]
"""Numpy arrays by name."""


class DomainEnv(gymnasium.Env[EnvObservation, Any]):
    """A round of a domain, seen by an unaided person in one of the domain's settings.

    All mechanics are the domain's: this class only draws the round, hides what the setting hides
    and counts steps. Each domain has a subclass with its observation space. Where another simulator
    moves things, a subclass overrides `_begin` and `_advance`; with continuous actions also
    `_actions` and `_checked`.

    Attributes:
        domain: the world.
        limits: least and largest value of each feature by name, ``"ego"`` ``[E]`` and each modality
            ``[F]``.

    Args:
        setting: one of the domain's settings; the first unless given.
        scenario: a name among its scenarios, or None for a random one in each round.
        render_mode: "rgb_array" or None.

    Raises:
        UnknownNameError: if the setting, the scenario or the render mode is not a known one.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": 4}
    domain: ClassVar[Domain]
    limits: ClassVar[Mapping[str, tuple[list[float], list[float]]]]

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

        self.action_space = self._actions()
        self.observation_space = _observation_space(domain, self.limits)
        self._state: Any = None
        self._scenario_name = ""
        self._step = 0

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
        self._state = self._begin(index, int(self.np_random.integers(2**63 - 1)))
        self._scenario_name = scenarios[index]
        self._step = 0
        return self._observation(), self._info()

    def step(self, action: Any) -> tuple[EnvObservation, float, bool, bool, dict[str, Any]]:
        """Play one step; see `gymnasium.Env.step`.

        Raises:
            ResetNeeded: before the first reset, and after the last step of a round.
            InvalidAction: if there is no such action.
        """
        before = self.state
        if self._step == self.domain.horizon or bool(self.domain.over(before)):
            raise ResetNeeded("call reset() to start a round")
        chosen = self._checked(action)
        if chosen is None:
            raise InvalidAction(f"expected an action of {self.action_space}, given {action!r}")
        following = self._advance(before, chosen)
        terms = self.domain.rewards(before, chosen, following)
        self._state = following
        self._step += 1
        info = self._info()
        # Adding zero turns the -0.0 of a penalty that does not apply into 0.0.
        info["rewards"] = {name: term.item() + 0.0 for name, term in terms.items()}
        reward = total_reward(terms).item() + 0.0
        terminated = bool(self.domain.over(following))
        truncated = self._step == self.domain.horizon and not terminated
        return self._observation(), reward, terminated, truncated, info

    @property
    def state(self) -> Any:
        """The true state, without batch, as the domain's functions take it.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self._state is None:
            raise ResetNeeded("call reset() to start a round")
        return self._state

    def render(self) -> np.ndarray | None:
        """Return a picture ``uint8 [height, width, 3]`` of the state.

        Returns:
            The picture, or None if the environment was made without a render mode.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('make the environment with render_mode="rgb_array" to render it')
            return None
        return self._picture(self.state)

    def _actions(self) -> spaces.Space[Any]:
        """Return the action space."""
        return spaces.Discrete(len(self.domain.actions))

    def _checked(self, action: Any) -> Tensor | None:
        """Return an action as the domain takes it; None if there is no such action."""
        return torch.tensor(int(action)) if self.action_space.contains(action) else None

    def _begin(self, scenario: int, seed: int) -> Any:
        """Return the state in which a round of a scenario begins, given by its index."""
        # The domain draws from torch's generators; this one depends on Gymnasium's seed.
        generator = torch.Generator().manual_seed(seed)
        batch = self.domain.initial(1, generator, torch.tensor([scenario]))
        return map_state(lambda part: part[0], batch)

    def _advance(self, state: Any, action: Tensor) -> Any:
        """Return the state after an action."""
        return self.domain.transition(state, action)

    def _picture(self, state: Any) -> np.ndarray:
        """Draw the full state, seen or not."""
        return self.domain.render(state)

    def _observation(self) -> EnvObservation:
        """Return what the person sees, as new numpy arrays."""
        values = self.domain.observe(self._state)
        masks = self.domain.visibility(self.setting, values)
        seen: EnvObservation = {"ego": values["ego"].numpy().astype(np.float32)}
        for name, mask in masks.items():
            shown = torch.where(mask[..., None], values[name], 0.0)
            seen[name] = shown.numpy().astype(np.float32)
            seen[f"{name}_mask"] = mask.numpy().astype(np.int8)
        return seen

    def _info(self) -> dict[str, Any]:
        state = {
            name: part.numpy().copy() if part.dim() else part.item()
            for name, part in vars(self._state).items()
        }
        return {"scenario": self._scenario_name, "state": state}


def _observation_space(
    domain: Domain, limits: Mapping[str, tuple[list[float], list[float]]]
) -> spaces.Dict:
    def box(name: str, *shape: int) -> spaces.Box:
        low, high = (np.array(limit, dtype=np.float32) for limit in limits[name])
        return spaces.Box(np.broadcast_to(low, shape), np.broadcast_to(high, shape))

    parts: dict[str, spaces.Space[Any]] = {"ego": box("ego", len(domain.ego_features))}
    for modality in domain.modalities:
        items = len(modality.items)
        parts[modality.name] = box(modality.name, items, len(modality.features))
        parts[f"{modality.name}_mask"] = spaces.MultiBinary(items)
    return spaces.Dict(parts)

"""What worlds of Gymnasium environments have in common: how one is made, looked at and stepped."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from mirror_ppl.domains.controls import action_at
from mirror_ppl.domains.world import World
from mirror_ppl.errors import DomainError, InputError

CLOSE = 1e-6
"""Largest difference between rewards that count as equal."""
UNSEEN = "something that matters cannot be observed"


class EnvironmentWorld(World):
    """Base class of :class:`~mirror_ppl.domains.gymnasium_world.GymnasiumWorld` and
    :class:`~mirror_ppl.domains.stepped_world.SteppedWorld`.

    The environment has to be deterministic between resets, and unobserved parts of its state must
    not matter.

    Attributes:
        moves: the environment's actions that people may take, in the order of ``actions``; the
            first ones unless given. Without meaning where there are ``controls``.
        layouts: number of resets, with the seeds 0, 1 and so on.
    """

    moves: tuple[int, ...] = ()
    layouts: int = 20

    @abstractmethod
    def make(self) -> gym.Env:
        """Make the environment."""

    @abstractmethod
    def look(self, env: Any) -> Mapping[str, Any]:
        """Return the full observation: ``ego`` ``[E]``, each modality ``[K, F]``."""

    @abstractmethod
    def knows(self, observation: Mapping[str, Any]) -> bool:
        """True if an observation from `look` is one of this world's."""

    def terms(self, env: Any, action: Any, reward: float, terminated: bool) -> dict[str, float]:
        """Return reward terms of a step by name; the environment is in the state after it."""
        del env, action, terminated
        return {self.reward_terms[0]: reward}

    @property
    def _moves(self) -> tuple[int, ...]:
        return self.moves or tuple(range(len(self.actions)))

    def commands(self, env: gym.Env) -> list[Any]:
        """Return the environment's action for each of the world's.

        Raises:
            DomainError: the environment does not have these actions.
        """
        space = env.action_space
        if self.controls:
            if not isinstance(space, gym.spaces.Box) or space.shape != (len(self.controls),):
                raise DomainError(
                    f"{self.name}: expected a Box of {len(self.controls)} numbers (controls), "
                    f"found {space}"
                )
            for one, low, high in zip(self.controls, space.low, space.high, strict=True):
                if one.low < low or one.high > high:
                    raise DomainError(
                        f"{self.name}: {one.name} is {one.low:g} to {one.high:g}, but the "
                        f"environment takes {low:g} to {high:g}"
                    )
            every = self.control_values(torch.arange(len(self.actions)))
            return list(every.numpy().astype(space.dtype))
        if not isinstance(space, gym.spaces.Discrete):
            raise DomainError(
                f"{self.name}: expected actions that are numbered (Discrete), found {space}; give "
                "controls instead of actions"
            )
        moves = self._moves
        if len(moves) != len(self.actions):
            raise DomainError(f"{self.name}: {len(self.actions)} actions, but {len(moves)} moves")
        if max(moves) >= space.n:
            raise DomainError(
                f"{self.name}: the environment has {space.n} actions, from 0 on, and no "
                f"{max(moves)} (actions, moves)"
            )
        return list(moves)

    def action_of(self, command: Any) -> tuple[int, np.ndarray | None]:
        """Return the action of an environment's action, and the control values ``[C]`` of it.

        Raises:
            InputError: people have no such action.
        """
        if not self.controls:
            moves = self._moves
            if command not in moves:
                raise InputError(f"action has to be one of {moves} (moves), not {command!r}")
            return moves.index(command), None
        return action_at(self.controls, command), np.array(command, float)


def as_tensors(observation: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return an observation from `look` as tensors, in the order of names."""
    dtype = torch.get_default_dtype()
    return {
        name: torch.tensor(np.array(part, float), dtype=dtype)
        for name, part in sorted(observation.items())
    }

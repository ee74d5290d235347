"""What worlds of Gymnasium environments share: one is made, looked at, stepped and checked."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from copy import copy
from operator import index
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from mirror_ppl.domains.controls import action_at
from mirror_ppl.domains.world import World
from mirror_ppl.errors import DomainError, InputError, shown

CLOSE = 1e-6
"""Largest difference between rewards that count as equal."""
UNSEEN = "something that matters cannot be observed"
PLAYED = 6
"""Number of rounds that a check plays."""
TOLERANCE = 1e-4
"""Differences up to this, and to this share of a value, are rounding."""
VARIES = "look() varies where nothing was done"


class EnvironmentWorld(World):
    """Base class of :class:`~mirror_ppl.domains.gymnasium_world.GymnasiumWorld` and
    :class:`~mirror_ppl.domains.stepped_world.SteppedWorld`.

    Unobserved parts of the environment's state must not matter.

    Attributes:
        moves: the environment's actions that people may take, in the order of ``actions``; the
            first ones unless given. Without meaning where there are ``controls``.
        layouts: number of resets, with the seeds 0, 1 and so on.
    """

    moves: tuple[int, ...] = ()
    layouts: int = 20

    @property
    def likely_cause(self) -> str:
        """Name what may be wrong where outcomes are not those of the environment."""
        return f"steps are random (then it has to be a SteppedWorld), or {UNSEEN}"

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

    def made(self) -> gym.Env:
        """Return what `make` returns.

        Raises:
            DomainError: it is no environment.
        """
        env = self.make()
        if not isinstance(env, gym.Env):
            raise DomainError(f"{self.name}: make() has {shown(env)}, expected a gymnasium.Env")
        return env

    def seen(self, env: gym.Env) -> Mapping[str, Any]:
        """Return what `look` returns.

        Raises:
            DomainError: it is not a mapping.
        """
        found = self.look(env.unwrapped)
        if not isinstance(found, Mapping):
            raise DomainError(f"{self.name}: look() has {shown(found)}, expected a dict of arrays")
        return found

    def require_shapes(self, seen: Mapping[str, Any]) -> dict[str, torch.Size]:
        """Return the shapes of an observation from `look`, in the order of names.

        Raises:
            DomainError: they are not the world's.
        """
        expected = {"ego": torch.Size((len(self.ego_features),))} | {
            m.name: torch.Size((len(m.items), len(m.features))) for m in self.modalities
        }
        found = {name: torch.Size(np.shape(part)) for name, part in seen.items()}
        if found != expected:
            raise DomainError(
                f"{self.name}: look() has {_listed(found)}, expected {_listed(expected)}"
            )
        return dict(sorted(expected.items()))

    def stepped(self, env: gym.Env, command: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step an environment, which may change the command that it is given.

        Raises:
            DomainError: it does not return five values.
        """
        found = env.step(copy(command))
        if not isinstance(found, tuple | list) or len(found) != 5:
            number = f"{len(found)} values" if isinstance(found, tuple | list) else shown(found)
            raise DomainError(
                f"{self.name}: step() of the environment has {number}, expected observation, "
                "reward, terminated, truncated and info"
            )
        observation, reward, terminated, truncated, info = found
        return observation, reward, terminated, truncated, info

    def named_terms(
        self, env: gym.Env, action: Any, reward: Any, terminated: bool
    ) -> dict[str, float]:
        """Return `terms` of a step that an environment has taken, its reward of any numeric kind.

        Raises:
            DomainError: they are not the world's.
        """
        own = self.terms(env.unwrapped, action, float(reward), bool(terminated))
        if not isinstance(own, Mapping) or set(own) != set(self.reward_terms):
            found = ", ".join(own) if isinstance(own, Mapping) else shown(own)
            raise DomainError(
                f"{self.name}: terms() has {found}, expected "
                f"{', '.join(self.reward_terms)} (reward_terms)"
            )
        try:
            if not any(np.ndim(value) for value in own.values()):
                return {name: float(value) for name, value in own.items()}
        except (TypeError, ValueError):
            pass
        found = ", ".join(f"{name} {shown(value)}" for name, value in own.items())
        raise DomainError(f"{self.name}: terms() has {found}, expected numbers")

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
            try:
                number = None if isinstance(command, bool | np.bool_) else index(command)
            except TypeError:
                number = None
            if number not in moves:
                raise InputError(f"action has to be one of {moves} (moves), not {command!r}")
            return moves.index(number), None
        return action_at(self.controls, command), np.array(command, float).clip(*self._bounds)

    @property
    def _bounds(self) -> np.ndarray:
        """Least and largest values of the controls, ``[2, C]``."""
        return np.transpose([(one.low, one.high) for one in self.controls])

    def seed_chance(self, env: gym.Env, state: Any) -> None:
        """Let an environment draw in its next step what the state holds; nothing is drawn here."""

    def own_faults(self) -> list[str]:
        """Return the first fault found in rounds of random actions, played from resets on.

        The environment is not put anywhere: each step has to be the one that the world computes
        from what was observed before it.
        """
        env, chooser = self.made(), np.random.default_rng(0)
        commands, inner = self.commands(env), env
        while isinstance(inner, gym.Wrapper):
            limit = getattr(inner, "_max_episode_steps", self.horizon)
            if limit < self.horizon:
                return [f"the environment truncates rounds; horizon may be {limit} at most"]
            inner = inner.env
        for seed in range(min(PLAYED, self.layouts)):
            env.reset(seed=seed)
            first, again = as_tensors(self.seen(env)), as_tensors(self.seen(env))
            if not all(np.array_equal(first[n], again[n], equal_nan=True) for n in first):
                return [VARIES]
            if bool(self.over(self.state_behind(first))):
                return [f"the task is done where rounds begin (seed {seed})"]
            for step in range(self.horizon):
                number = int(chooser.integers(len(commands)))
                command, action = commands[number], torch.tensor(number)
                if self.controls:
                    command = chooser.uniform(*self._bounds).astype(command.dtype)
                    action = torch.from_numpy(command).to(torch.get_default_dtype())
                fault, end = self._fault_of_step(env, command, action, step)
                if fault:
                    return [f"step {step} after reset(seed={seed}): {fault}"]
                if end:
                    break
        return []

    def _fault_of_step(
        self, env: gym.Env, command: Any, action: Tensor, step: int
    ) -> tuple[str, bool]:
        """Take a step; return what the world computes otherwise, and whether it ended."""
        state = self.state_behind(as_tensors(self.seen(env)))
        self.seed_chance(env, state)
        _, reward, end, cut, _ = self.stepped(env, command)
        terms, found = self.named_terms(env, command, reward, end), self.seen(env)
        fault = self.fault_of_step(state, command, action, terms, found, bool(end))
        if not fault and cut and not end and step + 1 < self.horizon:
            fault = f"the environment truncates rounds; horizon may be {step + 1} at most"
        return fault, bool(end)

    def fault_of_step(
        self,
        state: Any,
        command: Any,
        action: Tensor,
        terms: Mapping[str, float],
        seen: Mapping[str, Any],
        end: bool,
    ) -> str:
        """Return what the world computes otherwise than an environment did; empty if nothing.

        Args:
            state: before the step.
            command: the environment's action.
            action: the world's.
            terms: reward terms of the step.
            seen: after the step.
            end: whether the environment has terminated.
        """
        own, found = as_tensors(terms), as_tensors(seen)
        following = self.transition(state, action)
        for values, computed in (
            (found, self.observe(following)),
            (own, self.rewards(state, action, following)),
        ):
            for name, value in values.items():
                if bool(((computed[name] - value).abs() > TOLERANCE * (1 + value.abs())).any()):
                    return (
                        f"after {command}, {name} is {value.tolist()} in the environment, but "
                        f"computed as {computed[name].tolist()}; {self.likely_cause}"
                    )
        if end != bool(self.over(following)):
            ended = "has terminated" if end else "has not terminated"
            return f"after {command} the environment {ended}, but the world says otherwise (done)"
        return ""


def _listed(shapes: Mapping[str, torch.Size]) -> str:
    return ", ".join(f"{name} {tuple(size)}" for name, size in sorted(shapes.items()))


def as_tensors(observation: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return an observation from `look` as tensors, in the order of names."""
    dtype = torch.get_default_dtype()
    return {
        name: torch.tensor(np.array(part, float), dtype=dtype)
        for name, part in sorted(observation.items())
    }

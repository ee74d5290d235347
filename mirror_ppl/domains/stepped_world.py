"""Worlds from Gymnasium environments that are put into a state and stepped whenever it is needed.

Inference and planning need pure functions of states. Here a state is the full observation of it:
the environment is put there, stepped once, and looked at. Outcomes are kept, as the same ones are
asked for again and again. This takes environments with any number of states and with continuous
actions, and a few hundredths of a millisecond more than a step of the environment.

Where steps draw from the environment's generator, a state also holds the seed of the next draw.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any
from zlib import crc32

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation
from mirror_ppl.domains.controls import bounds_in_words, within_bounds
from mirror_ppl.domains.environment_world import (
    CLOSE,
    TOLERANCE,
    UNSEEN,
    VARIES,
    EnvironmentWorld,
)
from mirror_ppl.errors import DomainError, shown

CACHED = (
    "_env",
    "_commands",
    "_sizes",
    "_outcomes",
    "_starts",
    "_done",
    "_left_to_try",
    "_ends_to_try",
    "seconds",
    "elsewhere",
)
"""Attributes that are of one process: the environment, and what was seen of it."""
WORTH_SHARING = 0.1
"""Seconds of stepping from which on other processes are asked."""
SLOW = 5e-4
"""Seconds of a step from which on they are; faster ones take as long to send."""
MOST_OUTCOMES = 500_000
"""Number of outcomes that are kept."""
SEEDS = 2**31
"""Number of seeds of what happens by chance."""
TRIED_TWICE = 100
"""Number of outcomes that are computed twice, to detect what cannot be observed."""
ENDS_TRIED = 20
"""Number of those at which the task is done."""

Trial = tuple[np.ndarray, Any, int]
"""A full observation, the environment's action, and the seed of what is drawn."""
Outcome = tuple[np.ndarray, bool, np.ndarray]
"""The full observation after a step, whether the task is done, and the reward terms."""


@dataclass(frozen=True)
class Moment:
    """Full observations, which are the states.

    Attributes:
        values: flattened and joined in the order of names, ``[..., N]``.
        done: where the task is done, ``[...]``.
        seed: of what the next step draws, ``[...]``; 0 in worlds that are not random.
    """

    values: Tensor
    done: Tensor
    seed: Tensor


class SteppedWorld(EnvironmentWorld):
    """Base class of a world from a Gymnasium environment of any size; derive from it.

    Implement ``make()``, ``look(env)`` and :meth:`restore`; also :meth:`done` where rounds can end
    before the horizon. ``random = True`` is for environments whose steps draw from ``np_random``.

    Attributes:
        elsewhere: what other processes compute for this one, see
            :func:`mirror_ppl.stepping.stepped_by`; None if there are none.
    """

    layouts = 1000
    elsewhere: Callable[[Sequence[Trial]], list[Outcome]] | None = None

    @property
    def likely_cause(self) -> str:
        """Name what may be wrong where outcomes are not those of the environment."""
        chance = (
            "steps draw from another generator than np_random, or from one kept from reset()"
            if self.random
            else "steps are random (then random = True)"
        )
        return f"restore() does not set all that step() reads, {chance}, or {UNSEEN}"

    @abstractmethod
    def restore(self, env: Any, observation: Mapping[str, np.ndarray]) -> None:
        """Put the environment, after some reset, into the state with this full observation.

        Everything that ``step`` reads has to be set, counters of terminated steps included.
        """

    def done(self, env: Any) -> bool:
        """True if the task is done in the environment's state: where it terminates."""
        del env
        return False

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without the environment; other processes make their own."""
        own = {name: part for name, part in vars(self).items() if name not in CACHED}
        return own | {"_dtype": self._dtype}

    def knows(self, observation: Mapping[str, Any]) -> bool:
        """True: all observations are states."""
        del observation
        return True

    def initial(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> Moment:
        """Draw resets of the environment, uniformly from its ``layouts``."""
        del scenario
        device = generator.device
        seeds = torch.randint(self.layouts, (batch,), generator=generator, device=device).tolist()
        for seed in set(seeds) - self._starts.keys():
            self._env.reset(seed=seed)
            if self._ends():
                raise DomainError(f"{self.name}: the task is done where rounds begin (seed {seed})")
            self._starts[seed] = torch.from_numpy(self._look())
        values = torch.stack([self._starts[seed] for seed in seeds]).to(device)
        begun = torch.zeros(batch, dtype=torch.bool, device=device)
        return self.redrawn(Moment(values, begun, begun.long()), generator)

    def redrawn(self, state: Moment, generator: torch.Generator) -> Moment:
        """Draw seeds anew if the world is random."""
        if not self.random:
            return state
        shape, device = state.seed.shape, generator.device
        return replace(state, seed=torch.randint(SEEDS, shape, generator=generator, device=device))

    def transition(self, state: Moment, action: Tensor) -> Moment:
        """Step the environment; a task that is done stays as it is."""
        found, _ = self._stepped(state, action)
        return found

    def rewards(self, state: Moment, action: Tensor, following: Moment) -> dict[str, Tensor]:
        """Step the environment; 0 where the task is done."""
        del following
        _, earned = self._stepped(state, action)
        return dict(zip(self.reward_terms, earned.unbind(-1), strict=True))

    def over(self, state: Moment) -> Tensor:
        """Return where the environment has terminated."""
        return state.done

    def observe(self, state: Moment) -> Observation:
        """Return the full observation, which the state is."""
        shape = state.values.shape[:-1]
        parts = state.values.split([size.numel() for size in self._sizes.values()], -1)
        return {
            name: part.reshape(*shape, *size)
            for (name, size), part in zip(self._sizes.items(), parts, strict=True)
        }

    def state_behind(self, observation: Observation) -> Moment:
        """Return the state, which the observation is."""
        shape = observation["ego"].shape[:-1]
        parts = [observation[n].reshape(*shape, size.numel()) for n, size in self._sizes.items()]
        values = torch.cat(parts, -1)
        seed = torch.zeros(shape, dtype=torch.long, device=values.device)
        done, rows = seed.bool(), ()
        if self.random or type(self).done is not SteppedWorld.done:
            rows = values.reshape(shape.numel(), values.shape[-1]).cpu()
        if type(self).done is not SteppedWorld.done:
            done = torch.tensor([self._is_done(row) for row in rows], dtype=torch.bool)
            done = done.view(shape).to(values.device)
        if self.random:  # unknown, but the same whenever this is asked
            seed = torch.tensor(
                [crc32(row.numpy().tobytes()) % SEEDS for row in rows], dtype=torch.long
            )
            seed = seed.view(shape).to(values.device)
        return Moment(values, done, seed)

    def seed_chance(self, env: gym.Env, state: Moment) -> None:
        """Let an environment draw what follows in the state ``[]``, if the world is random."""
        self._seed(env, int(state.seed))

    def _seed(self, env: gym.Env, seed: int) -> None:
        if self.random:
            env.unwrapped.np_random = np.random.Generator(np.random.SFC64(seed))

    def _stepped(self, state: Moment, action: Tensor) -> tuple[Moment, Tensor]:
        """Return the next states ``[...]`` and the reward terms ``[..., R]``."""
        continuous = action.is_floating_point()
        device, batch = state.values.device, action.shape[: action.dim() - continuous]
        shape = torch.broadcast_shapes(state.done.shape, batch)
        width, number = state.values.shape[-1], shape.numel()
        rows = state.values.expand((*shape, -1)).reshape(number, width).cpu()
        ended = state.done.expand(shape).reshape(-1).tolist()
        deeds = action.expand((*shape, *action.shape[len(batch) :]))
        deeds = deeds.reshape(number, action.shape[-1] if continuous else 1).cpu()
        seeds = state.seed.expand(shape)
        outcomes = self._outcomes
        if len(outcomes) > MOST_OUTCOMES:
            outcomes.clear()
        kind = bytes([continuous])  # an index and control values may have the same bytes
        own, keys, new = rows.numpy(), [], {}
        each = zip(own, deeds.numpy(), ended, seeds.flatten().tolist(), strict=True)
        for row, deed, end, seed in each:
            key = b"" if end else kind + row.tobytes() + deed.tobytes() + seed.to_bytes(4)
            keys.append(key)
            if not end and key not in outcomes and key not in new:
                new[key] = (row, self._command(deed, continuous), seed)
        if new:
            outcomes.update(zip(new, self.outcomes(list(new.values())), strict=True))
        stay = np.zeros(len(self.reward_terms))
        found = [
            outcomes[key] if key else (row, True, stay) for key, row in zip(keys, own, strict=True)
        ]
        values = torch.from_numpy(np.array([one for one, _, _ in found], own.dtype)).to(device)
        done = torch.tensor([one for _, one, _ in found], dtype=torch.bool, device=device)
        earned = torch.from_numpy(np.array([one for _, _, one in found], float)).to(values)
        if self.random:  # a full cycle of all seeds
            seeds = torch.where(state.done, seeds, (seeds * 1103515245 + 12345) % SEEDS)
        moment = Moment(values.view(*shape, width), done.view(shape), seeds)
        return moment, earned.view(*shape, len(self.reward_terms))

    def _command(self, deed: np.ndarray, continuous: bool) -> Any:
        """Return the environment's action, by its number or its control values."""
        if not continuous:
            return self._commands[int(deed[0])]
        if not bool(within_bounds(self.controls, torch.tensor(deed)).all()):
            raise DomainError(
                f"{self.name}: controls are {bounds_in_words(self.controls)}, not {deed.tolist()}"
            )
        return deed

    def outcomes(self, trials: Sequence[Trial]) -> list[Outcome]:
        """Return what follows, computed here or, where that takes long, `elsewhere`."""
        slow = self.seconds >= SLOW and len(trials) * self.seconds >= WORTH_SHARING
        if self.elsewhere is not None and slow:
            return self.elsewhere(trials)
        begun = time.perf_counter()
        found = [self._tried(*trial) for trial in trials]
        self.took((time.perf_counter() - begun) / len(trials))
        return found

    def took(self, seconds: float) -> None:
        """Keep the seconds that an outcome took, to decide where the next are computed."""
        vars(self)["seconds"] = seconds

    def _tried(self, row: np.ndarray, command: Any, seed: int) -> Outcome:
        found = self._step(row, command, seed)
        reached, end, _ = found
        left = self._ends_to_try if end else self._left_to_try
        if left:
            left.pop()
            again = self._step(row, command, seed)
            self._restored(row)  # from elsewhere; it may be imagined, so it need not look the same
            self._require_done(row, False)
            self._restored(reached)
            off = np.abs(self._look() - reached) > TOLERANCE * (1 + np.abs(reached))
            if off.any():
                if (self._look() != self._look()).any():
                    raise DomainError(f"{self.name}: {VARIES}")
                raise DomainError(
                    f"{self.name}: restore() of the observation {reached.tolist()} leads to "
                    f"{self._look().tolist()}"
                )
            self._require_done(reached, end)
            for one, other in zip(found, again, strict=True):
                if np.abs(np.subtract(one, other, dtype=float)).max() > CLOSE:
                    raise DomainError(
                        f"{self.name}: outcomes of {command} in {row.tolist()} vary; "
                        f"{self.likely_cause}"
                    )
        return found

    def _require_done(self, row: np.ndarray, end: bool) -> None:
        if self._ends() != end:
            raise DomainError(
                f"{self.name}: done() is {not end} after restore() of {row.tolist()}, expected "
                f"{end}; restore() does not set all that done() reads"
            )

    def _step(self, row: np.ndarray, command: Any, seed: int) -> Outcome:
        self._restored(row)
        self._seed(self._env, seed)
        _, reward, terminated, _, _ = self.stepped(self._env, command)
        end = bool(terminated)
        if end != self._ends():
            raise DomainError(
                f"{self.name}: the environment {'is' if end else 'is not'} terminated after "
                f"{command} in {row.tolist()}, but done() says otherwise"
            )
        own = self.named_terms(self._env, command, reward, end)
        earned = np.array([own[name] for name in self.reward_terms], float)
        return self._look(), end, earned

    def _restored(self, row: np.ndarray) -> None:
        row, observation, begin = row.copy(), {}, 0  # an environment may change what it is given
        for name, size in self._sizes.items():
            observation[name] = row[begin : begin + size.numel()].reshape(tuple(size))
            begin += size.numel()
        self.restore(self._env.unwrapped, observation)

    def _ends(self) -> bool:
        """Return what `done` says of the environment as it is."""
        end = self.done(self._env.unwrapped)
        if np.ndim(end):
            raise DomainError(f"{self.name}: done() has {shown(end)}, expected True or False")
        return bool(end)

    def _is_done(self, row: Tensor) -> bool:
        key = row.numpy().tobytes()
        if len(self._done) > MOST_OUTCOMES:
            self._done.clear()
        if key not in self._done:
            self._restored(row.numpy())
            self._done[key] = self._ends()
        return self._done[key]

    def _look(self) -> np.ndarray:
        seen = self.seen(self._env)
        flat = [np.asarray(seen[name], self._dtype).ravel() for name in self._sizes]
        row = np.concatenate(flat)
        if not np.isfinite(row).all():
            raise DomainError(f"{self.name}: look() has {row.tolist()}, expected finite numbers")
        return row

    @cached_property
    def _dtype(self) -> np.dtype:
        return torch.empty(0).numpy().dtype  # torch's default

    @cached_property
    def seconds(self) -> float:
        """Seconds that an outcome took in the last batch; 0 at first."""
        return 0.0

    @cached_property
    def _env(self) -> gym.Env:
        env = self.made()
        env.reset(seed=0)
        return env

    @cached_property
    def _commands(self) -> list[Any]:
        return self.commands(self._env)

    @cached_property
    def _sizes(self) -> dict[str, torch.Size]:
        """Shapes of the parts of an observation, in the order of names."""
        return self.require_shapes(self.seen(self._env))

    @cached_property
    def _starts(self) -> dict[int, Tensor]:
        return {}  # observations after resets, by seed

    @cached_property
    def _outcomes(self) -> dict[bytes, Outcome]:
        return {}  # by observation and action

    @cached_property
    def _done(self) -> dict[bytes, bool]:
        return {}

    @cached_property
    def _left_to_try(self) -> list[None]:
        return [None] * TRIED_TWICE

    @cached_property
    def _ends_to_try(self) -> list[None]:
        return [None] * ENDS_TRIED

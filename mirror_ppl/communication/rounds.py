"""The round so far: observations, actions and messages up to the present step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.checks import (
    flags,
    numbers,
    require_keys,
    require_kind,
    require_methods,
    require_shape,
    whole_number,
    whole_numbers,
)
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains import require_known
from mirror_ppl.domains.base import Domain, Observation, Visibility
from mirror_ppl.errors import InputError, shown

EGO = "ego"


@dataclass(frozen=True)
class RoundSoFar:
    """A round up to the moment at which the person is about to act for the (t + 1)-th time.

    Arrays may be tensors, numpy arrays or lists of any numeric kind, and are kept as tensors:
    observations in torch's default dtype, actions as int64, messages as bool (1 and 0 are
    accepted), all on the device of the ego's features.

    Attributes:
        observation: full observation of the robot at each step: ego ``[t + 1, E]``, each modality
            ``[t + 1, K, F]``.
        actions: the person's actions, ``[t]``.
        told: items communicated to them at each step, by modality ``[t, K]``.

    Raises:
        InputError: these are no such arrays, or their sizes do not match. `check` tests whether
            they are possible in a domain.
    """

    observation: Observation
    actions: Tensor
    told: Visibility

    def __post_init__(self) -> None:
        observation = _observation(self.observation)
        device = observation[EGO].device
        actions = whole_numbers(self.actions, "actions", device)
        if actions.dim() != 1:
            raise InputError(f"actions has shape {tuple(actions.shape)}, expected one dimension")
        steps = len(actions)
        modalities = [name for name in observation if name != EGO]
        given = require_keys(self.told, modalities, "told")
        told = {name: flags(given[name], f'told "{name}"', device) for name in given}
        for name, value in observation.items():
            if len(value) != steps + 1:
                raise InputError(
                    f'{steps} actions go with {steps + 1} observations; "{name}" has {len(value)}'
                )
        for name, value in told.items():
            if value.dim() and len(value) != steps:
                raise InputError(
                    f'{steps} actions go with as many steps of told "{name}", not {len(value)}'
                )
            require_shape(value, (steps, observation[name].shape[1]), f'told "{name}"')
        for name, value in (("observation", observation), ("actions", actions), ("told", told)):
            object.__setattr__(self, name, value)

    @classmethod
    def begin(cls, domain: Domain, observation: Observation) -> RoundSoFar:
        """Begin a round with its first observation, ``[E]`` and ``[K, F]``.

        Raises:
            InputError: the observation is impossible.
        """
        require_methods(domain, ["observe", "faults"], "domain", "a domain")
        shapes = _shapes(domain)
        given = require_keys(observation, shapes, "the observation")
        first = {name: numbers(value, _the(name)) for name, value in given.items()}
        for name, value in first.items():
            require_shape(value, shapes[name], _the(name))
        past = cls(
            {name: value[None] for name, value in first.items()},
            torch.zeros(0, dtype=torch.long),
            {m.name: torch.zeros(0, len(m.items), dtype=torch.bool) for m in domain.modalities},
        )
        past.check(domain)
        return past

    @classmethod
    def of(
        cls, recordings: Demonstrations, person: str | None = None, number: int = 0, step: int = 0
    ) -> RoundSoFar:
        """Return a recorded round up to one of its steps.

        Args:
            recordings: of rounds.
            person: id; may be left out if there is only one person.
            number: of the round, from 0.
            step: the step at which the person is about to act, from 0.

        Raises:
            InputError: there is no such round or step, or several people and none is named.
            UnknownNameError: no person has that id.
        """
        people = require_kind(recordings, Demonstrations, "recordings").people
        if person is None and len(people) > 1:
            raise InputError(f"the recordings are of {len(people)} people: name one of them")
        name = require_known(next(iter(people)) if person is None else person, "person", people)
        who = people.index(name)
        rounds = int(recordings.round_counts[who])
        number = whole_number(number, "number", 0)
        if number >= rounds:
            raise InputError(f"{name} has rounds 0 to {rounds - 1}, not {number}")
        steps, step = int(recordings.lengths[who, number]), whole_number(step, "step", 0)
        if step > steps:
            raise InputError(f"round {number} of {name} has steps 0 to {steps}, not {step}")
        seen = recordings.observation().items()
        return cls(
            {key: value[who, number, : step + 1] for key, value in seen},
            recordings.actions[who, number, :step],
            {key: mask[who, number, :step] for key, mask in recordings.told.items()},
        )

    def then(self, told: Visibility, action: int | Tensor, observation: Observation) -> RoundSoFar:
        """Return the round one step later.

        Args:
            told: items communicated before the person acted, ``[K]`` by modality.
            action: index of their action.
            observation: the observation after it, ``[E]`` and ``[K, F]``.

        Raises:
            InputError: an argument is not of this kind and shape.
        """
        device = self.actions.device
        heard = require_keys(told, self.told, "told")
        seen = require_keys(observation, self.observation, "the observation")
        done = whole_numbers(action, "the action", device)
        if done.numel() != 1:
            raise InputError(f"the action has shape {tuple(done.shape)}, expected one number")
        now, new = {}, {}
        for name, before in self.observation.items():
            now[name] = numbers(seen[name], _the(name), device)
            require_shape(now[name], tuple(before.shape[1:]), _the(name))
        for name, before in self.told.items():
            new[name] = flags(heard[name], f'told "{name}"', device)
            require_shape(new[name], tuple(before.shape[1:]), f'told "{name}"')
        return RoundSoFar(
            {name: torch.cat([value, now[name][None]]) for name, value in self.observation.items()},
            torch.cat([self.actions, done.reshape(1)]),
            {name: torch.cat([value, new[name][None]]) for name, value in self.told.items()},
        )

    def check(self, domain: Domain) -> None:
        """Check that the round is possible in a domain.

        Raises:
            InputError: it is longer than the domain's rounds; or an observation, an action or a
                message is impossible.
        """
        if self.time > domain.horizon:
            raise InputError(
                f"the round has {self.time} steps, expected at most {domain.horizon}, as long as "
                f"rounds of {domain.name} are"
            )
        shapes = _shapes(domain)
        require_keys(self.observation, shapes, "the observation")
        for name, shape in shapes.items():
            value = self.observation[name]
            require_shape(value, (self.time + 1, *shape), _the(name))
            infinite = ~value.isfinite()
            if infinite.any():
                time, number = _first(value, infinite)
                raise InputError(
                    f"time {time}: {_the(name)} has {number:g}, expected finite numbers"
                )
        for rule, broken in domain.faults(self.observation).items():
            if broken.any():
                raise InputError(
                    f"time {int(broken.nonzero()[0])}: this observation cannot be: {rule}"
                )
        over = domain.over(domain.state_behind(self.observation))
        resumed = over[:-1] & ~over[1:]
        if resumed.any():
            time = int(resumed.nonzero()[0])
            raise InputError(f"the round was over at time {time}, but goes on at time {time + 1}")
        wrong = (self.actions < 0) | (self.actions >= len(domain.actions))
        if wrong.any():
            step, action = _first(self.actions, wrong)
            raise InputError(
                f"step {step}: there is no action {action}; actions count from 0 to "
                f"{len(domain.actions) - 1}"
            )

    @property
    def time(self) -> int:
        """Number of actions so far, t."""
        return len(self.actions)

    @property
    def now(self) -> Observation:
        """Last observation, ``[E]`` and ``[K, F]``."""
        return {name: value[-1] for name, value in self.observation.items()}

    def to(self, device: torch.device) -> RoundSoFar:
        """Return the round on another device."""
        if self.actions.device == device:
            return self
        observation = {name: value.to(device) for name, value in self.observation.items()}
        return RoundSoFar(observation, self.actions, self.told)


def _the(name: str) -> str:
    return f'the observation of "{name}"'


def _shapes(domain: Domain) -> dict[str, tuple[int, ...]]:
    """Return the shapes of one full observation, by name."""
    shapes = {m.name: (len(m.items), len(m.features)) for m in domain.modalities}
    return {EGO: (len(domain.ego_features),), **shapes}


def _observation(given: Any) -> Observation:
    """Convert observations ``[t + 1, ...]`` to tensors on one device."""
    if not isinstance(given, Mapping) or EGO not in given:
        what = ", ".join(map(shown, given)) if isinstance(given, Mapping) else shown(given)
        raise InputError(f'the observation must be a dict with "{EGO}" and modalities, not {what}')
    result, device = {}, None
    for name in (EGO, *(name for name in given if name != EGO)):
        result[name] = numbers(given[name], _the(name), device)
        device = result[EGO].device
        expected = "(t + 1, E)" if name == EGO else "(t + 1, K, F)"
        if result[name].dim() != expected.count(",") + 1:
            raise InputError(
                f"{_the(name)} has shape {tuple(result[name].shape)}, expected {expected}"
            )
    return result


def _first(value: Tensor, bad: Tensor) -> tuple[int, float]:
    """Return the first bad entry: its index along the first dimension, and its value."""
    return int(bad.nonzero()[0, 0]), value[bad][0].item()

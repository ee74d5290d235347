"""Recording of rounds that a person plays in a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains.base import Domain, require_known
from mirror_ppl.domains.environment_world import EnvironmentWorld, as_tensors
from mirror_ppl.domains.registry import known_domains
from mirror_ppl.errors import InputError


class Recorder(gym.Wrapper):
    """Keeps what happens in an environment, for `fit`::

        env = Recorder(world.make(), world, person="ada")
        env.reset(); env.tell("visual", "key"); env.step(2); ...
        save_demonstrations("ada.nc", env.recordings())

    A round begins with a reset and ends when the environment terminates or the world's horizon is
    reached; rounds without a step are not kept.

    Args:
        env: the environment that is played, like the world's own.
        world: defines observations and actions.
        person: id of the player; change the attribute when another person plays.
        setting: one of the world's settings; the last unless given.

    Raises:
        InputError: the world is no
            :class:`~mirror_ppl.domains.environment_world.EnvironmentWorld`, or was not added.
        UnknownNameError: there is no such setting.
    """

    def __init__(
        self, env: gym.Env, world: Domain, person: str = "person-01", setting: str | None = None
    ) -> None:
        super().__init__(env)
        if not isinstance(world, EnvironmentWorld):
            raise InputError(
                "the world has to be made from a Gymnasium environment (GymnasiumWorld, "
                "SteppedWorld); of others, save rounds by save_demonstrations"
            )
        if not any(world is known for known in known_domains()):
            raise InputError(
                f"{world.name} is not known; add it first, world = mirror_ppl.add_domain(...)"
            )
        self.world, self.person = world, person
        self.setting = require_known(
            setting or world.settings[-1], "setting", world.settings, world.name
        )
        self._rounds: list[_Round] = []
        self._told: list[tuple[str, int]] = []
        self._chooser = np.random.default_rng()
        self._chance = torch.Generator()
        self._chance.seed()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin a round; see `gymnasium.Env.reset`.

        Without a seed, one of the world's layouts is drawn.

        Raises:
            InputError: the round does not begin in one of the world's states.
            DomainError: what is observed has other shapes than the world's.
        """
        if not isinstance(self.person, str) or not self.person.strip():
            raise InputError(f"person has to be a name, not {self.person!r}")
        if seed is None:
            seed = int(self._chooser.integers(self.world.layouts))
        found = self.env.reset(seed=seed, options=options)
        first = self.world.seen(self.env)
        self.world.require_shapes(first)
        if not self.world.knows(first):
            raise InputError(
                f"seed {seed} begins in a state that {self.world.name} does not have; its layouts "
                f"are the seeds 0 to {self.world.layouts - 1}"
            )
        self._rounds.append(_Round(self.person, first))
        self._told = []
        return found

    def tell(self, modality: str, *items: str) -> None:
        """Record that items are communicated before the next action.

        Raises:
            InputError: the round has not begun or is over.
            UnknownNameError: there is no such modality or item.
        """
        known = {m.name: m.items for m in self.world.modalities}
        own = known[require_known(modality, "modality", tuple(known), self.world.name)]
        numbers = [own.index(require_known(item, "item", own, modality)) for item in items]
        self._require_begun()
        self._told += [(modality, number) for number in numbers]

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Play one step; see `gymnasium.Env.step`.

        Raises:
            InputError: the round has not begun or is over, the world has no such action, or it
                computes something else than the environment does; the round ends before this step.
            DomainError: the world is at fault where this step leads.
        """
        self._require_begun()
        number, control = self.world.action_of(action)
        if control is not None:  # within the bounds, where the given one is by a rounding error
            action = control.astype(np.asarray(action).dtype)
        now = self._rounds[-1]
        now.over = True  # if the step fails, the round cannot go on
        state = self.world.state_behind(as_tensors(now.seen[-1]))
        state = self.world.redrawn(state, self._chance)
        self.world.seed_chance(self.env, state)
        found, reward, terminated, truncated, info = self.world.stepped(self.env, action)
        command = torch.tensor(number)
        if control is not None:
            command = torch.from_numpy(control).to(torch.get_default_dtype())
        terms = self.world.named_terms(self.env, action, reward, terminated)
        seen = self.world.seen(self.env)
        fault = self.world.fault_of_step(state, action, command, terms, seen, bool(terminated))
        if fault:
            raise InputError(
                f"step {len(now.actions)}: {fault}; or this environment is not as make() returns "
                "it (wrappers, arguments)"
            )
        now.add(number, control, self._told, sum(terms.values()), seen)
        self._told = []
        at_horizon = len(now.actions) == self.world.horizon
        truncated = truncated or (at_horizon and not terminated)
        now.over = terminated or truncated
        return found, float(reward), terminated, truncated, info

    def _require_begun(self) -> None:
        if not self._rounds or self._rounds[-1].over:
            raise InputError("the round is over or has not begun; call reset()")

    def recordings(self) -> Demonstrations:
        """Return all rounds so far, by person in the order of their first rounds.

        Raises:
            InputError: there are none.
        """
        rounds = [one for one in self._rounds if one.actions]
        if not rounds:
            raise InputError("no round was played")
        people = tuple(dict.fromkeys(one.person for one in rounds))
        own = {name: [one for one in rounds if one.person == name] for name in people}
        number, steps = max(map(len, own.values())), max(len(one.actions) for one in rounds)
        shape = (len(people), number)
        actions = np.full((*shape, steps), -1)
        rewards = np.full((*shape, steps), np.nan)
        lengths = np.zeros(shape, int)
        controls = np.full((*shape, steps, len(self.world.controls)), np.nan)
        first = rounds[0].seen[0]
        seen = {
            name: np.full((*shape, steps + 1, *np.shape(part)), np.nan)
            for name, part in first.items()
        }
        told = {
            m.name: np.zeros((*shape, steps, len(m.items)), bool) for m in self.world.modalities
        }
        for person, name in enumerate(people):
            for place, one in enumerate(own[name]):
                lengths[person, place] = length = len(one.actions)
                actions[person, place, :length] = one.actions
                rewards[person, place, :length] = one.rewards
                if self.world.controls:
                    controls[person, place, :length] = one.controls
                for key, values in seen.items():
                    values[person, place, : length + 1] = [part[key] for part in one.seen]
                for step, said in enumerate(one.told):
                    for modality, item in said:
                        told[modality][person, place, step, item] = True
        return Demonstrations(
            domain=self.world.name,
            setting=self.setting,
            people=people,
            ego=torch.from_numpy(seen.pop("ego")),
            observations={name: torch.from_numpy(part) for name, part in seen.items()},
            actions=torch.from_numpy(actions),
            controls=torch.from_numpy(controls) if self.world.controls else None,
            rewards=torch.from_numpy(rewards),
            round_counts=torch.tensor([len(own[name]) for name in people]),
            lengths=torch.from_numpy(lengths),
            told={name: torch.from_numpy(part) for name, part in told.items()},
        )


class _Round:
    """A round in progress: observations, messages, actions and rewards."""

    def __init__(self, person: str, first: Mapping[str, Any]) -> None:
        self.person, self.over = person, False
        self.seen = [_copied(first)]
        self.actions: list[int] = []
        self.controls: list[np.ndarray | None] = []
        self.told: list[Sequence[tuple[str, int]]] = []
        self.rewards: list[float] = []

    def add(
        self,
        action: int,
        control: np.ndarray | None,
        told: Sequence[tuple[str, int]],
        reward: float,
        now: Mapping[str, Any],
    ) -> None:
        self.actions.append(action)
        self.controls.append(control)
        self.told.append(told)
        self.rewards.append(reward)
        self.seen.append(_copied(now))


def _copied(observation: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Copy an observation, as an environment may reuse its arrays."""
    return {name: np.array(part, float) for name, part in observation.items()}

"""Rollouts of the world under sequences of actions, shared by all candidate messages.

A message affects the world only through the person's actions, so the world is rolled out once for
all candidate messages: one future for each possible sequence of actions. A *path* is such a
sequence; paths are computed when first requested. The *name* of a path is a number, by which it
gets random numbers of its own: that of path ``p`` followed by action ``a`` is ``p * F + a``, and
that of the empty path is 0.

There are two worlds. `SelfModelWorld` is the robot's learned world model; `SimulatorWorld` is the
domain itself. W stands for draws of the world in which all paths are computed. In a random domain
paths begin in R *roots* instead, states with different futures, and each path is of one of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from mirror_ppl.checks import require_kind, require_methods, whole_number
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains.base import FUTURES, Domain, Observation, map_state, total_reward
from mirror_ppl.models.networks import Gaussian
from mirror_ppl.models.self_model import SelfModel

NAMES, FACTOR = 2**62, 0x2545F4914F6CDD1D
"""Up to this number of paths names count them: F is the number of actions. Names of more paths
overflow, and are practically different with this factor."""


class Dynamics(Protocol):
    """Dynamics of states ``[W, n]``, any dataclass of tensors."""

    def observe(self, state: Any) -> Observation:
        """Return the full observation, ``[W, n, ...]``."""
        ...

    def step(self, state: Any, action: Tensor, step: int) -> tuple[Tensor, Any]:
        """Return rewards ``[W, n]`` of actions ``[W, n]`` at a step, and the next states."""
        ...

    def value(self, state: Any) -> Tensor:
        """Return the optimal value of the states, ``[W, n]``."""
        ...


@dataclass
class _Paths:
    """Paths of one length, in the order in which they were requested.

    Attributes:
        state: the states that they lead to ``[W, n]``.
        name: of each, ``[n]``.
        observation: in these states, ``[W, n, ...]``.
        reward: of each action in the first m of these states, ``[W, m A]``.
        following: the states that follow ``[W, m A]``.
        child: index of the path at the next step, or -1 if not requested, ``[m A]``.
        value: optimal values of the first requested ones of ``state``.
        left: optimal values of the first requested ones of ``following``.
    """

    state: Any
    name: Tensor
    observation: Observation
    reward: Tensor | None = None
    following: Any = None
    child: Tensor | None = None
    value: Tensor | None = None
    left: Tensor | None = None


class RolloutTree:
    """Future observations and rewards along paths of actions.

    Args:
        dynamics: of the states.
        state: the present state ``[W, R]``; R is 1 or, in random domains, the number of futures.
        now: the present observation, ``[W, R, ...]``.
        actions: number of actions A.
        horizon: maximum number of steps.
    """

    def __init__(
        self, dynamics: Dynamics, state: Any, now: Observation, actions: int, horizon: int
    ):
        self.dynamics, self.actions = dynamics, actions
        self._factor = actions if actions**horizon <= NAMES else FACTOR
        root = torch.zeros(now["ego"].shape[1], dtype=torch.long, device=now["ego"].device)
        self._steps = [_Paths(state, root, now)]

    def observation(self, step: int) -> Observation:
        """Return observations after each path of ``step`` actions, ``[W, n, ...]``."""
        return self._steps[step].observation

    def names(self, step: int) -> Tensor:
        """Return names of the paths of ``step`` actions, ``[n]``."""
        return self._steps[step].name

    def rewards(self, step: int) -> Tensor:
        """Return rewards of each action after each path of ``step`` actions, ``[W, n, A]``."""
        reward = self._opened(step).reward
        assert reward is not None
        return reward.unflatten(1, (-1, self.actions))

    def values(self, step: int) -> Tensor:
        """Return the optimal value after each path of ``step`` actions, ``[W, n]``."""
        here = self._steps[step]
        here.value = self._valued(here.value, here.state)
        return here.value

    def advantages(self, step: int, discount: float = 1.0) -> Tensor:
        """Return the advantage of each action after each path of ``step`` actions, ``[W, n, A]``.

        ``r(s, a) + discount * V(s') - V(s)`` is 0 for the best action and negative for others.
        """
        here = self._opened(step)
        assert here.reward is not None
        here.left = self._valued(here.left, here.following)
        after = (here.reward + discount * here.left).unflatten(1, (-1, self.actions))
        return after - self.values(step)[..., None]

    def _valued(self, known: Tensor | None, state: Any) -> Tensor:
        """Return values of all states ``[W, n]``, the first of which are known."""
        if known is None:
            return self.dynamics.value(state)
        first = known.shape[1]
        new = map_state(lambda part: part[:, first:], state)
        return torch.cat([known, self.dynamics.value(new)], 1)

    def follow(self, step: int, path: Tensor, action: Tensor) -> Tensor:
        """Return paths extended by one action, ``[E]``; new ones are computed.

        Args:
            step: number of actions of the paths.
            path: ``[E]``.
            action: the next action of each, ``[E]``.
        """
        here = self._opened(step)
        assert here.child is not None
        branch = path * self.actions + action
        new = torch.unique(branch)
        new = new[here.child[new] < 0]
        if len(new):
            state = map_state(lambda part: part[:, new], here.following)
            name = here.name[new // self.actions] * self._factor + new % self.actions
            found = _Paths(state, name, self.dynamics.observe(state))
            known = 0
            if step + 1 < len(self._steps):
                there = self._steps[step + 1]
                known = len(there.name)
                there.state = _joined(there.state, state)
                there.name = torch.cat([there.name, name])
                there.observation = {
                    key: torch.cat([value, found.observation[key]], 1)
                    for key, value in there.observation.items()
                }
            else:
                self._steps.append(found)
            here.child[new] = known + torch.arange(len(new), device=new.device)
        return here.child[branch]

    def _opened(self, step: int) -> _Paths:
        """Return the paths of ``step`` actions, with the outcome of each action computed."""
        here = self._steps[step]
        known = 0 if here.child is None else len(here.child) // self.actions
        number = len(here.name) - known
        if not number:
            return here
        path = torch.arange(known, len(here.name), device=here.name.device)
        before = map_state(lambda part: part[:, path.repeat_interleave(self.actions)], here.state)
        action = torch.arange(self.actions, device=path.device).repeat(number)
        draws = here.observation["ego"].shape[0]
        reward, following = self.dynamics.step(before, action.expand(draws, -1), step)
        unknown = torch.full((number * self.actions,), -1, device=path.device)
        if here.child is None:
            here.reward, here.following, here.child = reward, following, unknown
        else:
            assert here.reward is not None
            here.reward = torch.cat([here.reward, reward], 1)
            here.following = _joined(here.following, following)
            here.child = torch.cat([here.child, unknown])
        return here


def _joined(first: Any, second: Any) -> Any:
    """Concatenate states ``[W, n]`` and ``[W, m]`` to ``[W, n + m]``."""
    return map_state(lambda *parts: torch.cat(parts, 1), first, second)


class World(Protocol):
    """A world that can be rolled forward."""

    draws: int

    def rollouts(self, past: RoundSoFar, horizon: int, generator: torch.Generator) -> RolloutTree:
        """Return the rollouts of H steps from a round so far, in W draws."""
        ...


class SimulatorWorld:
    """The domain's own simulator, from the state behind the last observation.

    Args:
        domain: the world; there is one draw unless it is ``random``.
    """

    def __init__(self, domain: Domain) -> None:
        require_methods(domain, ["transition", "state_behind"], "domain", "a domain")
        self.domain = domain
        self.draws = FUTURES if domain.random else 1

    def rollouts(self, past: RoundSoFar, horizon: int, generator: torch.Generator) -> RolloutTree:
        """Return the rollouts, see :class:`World`."""
        now = {
            name: value[None, None].expand(1, self.draws, *value.shape)
            for name, value in past.now.items()
        }
        state = self.domain.state_behind(now)
        state = self.domain.redrawn(state, generator)
        return RolloutTree(self, state, now, len(self.domain.actions), horizon)

    def observe(self, state: Any) -> Observation:
        """Return the full observation, see :class:`Dynamics`."""
        return self.domain.observe(state)

    def step(self, state: Any, action: Tensor, step: int) -> tuple[Tensor, Any]:
        """Return rewards and next states, see :class:`Dynamics`."""
        following = self.domain.transition(state, action)
        return total_reward(self.domain.rewards(state, action, following)), following

    def value(self, state: Any) -> Tensor:
        """Return the exact value of the best action, undiscounted; see :class:`Dynamics`."""
        return self.domain.reference_values(state, 1.0).amax(-1)


class SelfModelWorld:
    """The robot's learned world model: its latent states rolled forward.

    ``z_t`` comes from the encoder, which sees everything; then ``p(z_{t+1} | z_t, a_t)``,
    ``p(x_t | z_t)`` and ``p(r_t | z_t, a_t)``. Observations are the decoders' means, moved to the
    nearest possible observation; rewards are means too.

    Args:
        self_model: the robot's networks.
        draws: number of draws W of states; with one, every state is the mean.
    """

    def __init__(self, self_model: SelfModel, draws: int = 1) -> None:
        self.self_model = require_kind(self_model, SelfModel, "self_model")
        self.domain = self_model.domain
        self.draws = whole_number(draws, "draws", 1)

    def rollouts(self, past: RoundSoFar, horizon: int, generator: torch.Generator) -> RolloutTree:
        """Return the rollouts, see :class:`World`."""
        model = self.self_model
        device = past.actions.device
        shape = (self.draws, 1, model.latent)
        belief = robot_belief(model, past)
        noise = torch.zeros(horizon + 1, *shape, device=device, dtype=belief.mean.dtype)
        if self.draws > 1:
            noise.normal_(generator=generator)
        state = _Latent((belief.mean + belief.scale * noise[0]).expand(shape))
        now = {
            name: value[None, None].expand(self.draws, 1, *value.shape)
            for name, value in past.now.items()
        }
        dynamics = _LearnedDynamics(model, noise[1:])
        return RolloutTree(dynamics, state, now, len(model.domain.actions), horizon)


@dataclass(frozen=True)
class _Latent:
    """States ``[W, n, Z]`` of a self-model."""

    z: Tensor


@dataclass(frozen=True)
class _LearnedDynamics:
    """Dynamics of a self-model's states; all paths share the noise ``[H, W, 1, Z]``."""

    self_model: SelfModel
    noise: Tensor

    def observe(self, state: _Latent) -> Observation:
        model = self.self_model
        return model.domain.nearest(model.decode(state.z))

    def step(self, state: _Latent, action: Tensor, step: int) -> tuple[Tensor, _Latent]:
        following = self.self_model.transition(state.z, action)
        reward = self.self_model.reward(state.z, action).mean
        return reward, _Latent(following.mean + following.scale * self.noise[step])

    def value(self, state: _Latent) -> Tensor:
        return self.self_model.action_values(state.z).amax(-1)


def robot_belief(self_model: SelfModel, past: RoundSoFar) -> Gaussian:
    """Return ``q(z^R_t | ...)`` of the robot, which sees everything; parameters ``[Z]``.

    Where nothing is new (`World.nothing_new`), its belief stays, as people's does.
    """
    encoder, domain = self_model.encoder, self_model.domain
    everything = {
        m.name: torch.ones_like(past.observation[m.name][..., 0], dtype=torch.bool)
        for m in domain.modalities
    }
    evidence = self_model.evidence(past.observation, everything, past.actions)
    still = domain.nothing_new(past.observation)
    new = list(range(past.time + 1)) if still is None else (~still).nonzero().flatten().tolist()
    before = evidence.new_zeros(self_model.latent)
    for step in new[:-1]:
        before = encoder(before, evidence[step]).mean
    return encoder(before, evidence[new[-1]])

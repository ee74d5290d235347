"""Futures of the world under every course of actions, whoever takes them.

What a person is told changes what they do and nothing else, so the world is rolled out once for
all candidate messages: one future for each sequence of actions. A *path* is the number of such a
sequence: path ``p`` followed by action ``a`` is path ``p * A + a``, and the empty path is 0.

There are two worlds. `SelfModelWorld` is what the robot has learned; `SimulatorWorld` is the
domain itself, where it is at hand. W stands for draws of the world.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains.base import Domain, Observation, total_reward
from mirror_ppl.models.networks import Gaussian
from mirror_ppl.models.self_model import SelfModel


@dataclass(frozen=True)
class Futures:
    """What there will be to observe and to gain.

    Attributes:
        observations: at step h = 0 .. H - 1, of each path of h actions, ``[W, A**h, ...]``.
        rewards: of the last action of each path of h + 1 actions, ``[W, A**(h + 1)]``.
    """

    observations: list[Observation]
    rewards: list[Tensor]


class World(Protocol):
    """Something that can be rolled forward."""

    draws: int

    def futures(self, past: RoundSoFar, horizon: int, generator: torch.Generator) -> Futures:
        """Futures of H steps from a round so far, in W draws."""
        ...


class SimulatorWorld:
    """The domain's own simulator, from the state behind the last observation.

    Args:
        domain: the world; its transitions are deterministic, so one draw is all there is.
    """

    draws = 1

    def __init__(self, domain: Domain) -> None:
        self.domain = domain

    def futures(self, past: RoundSoFar, horizon: int, generator: torch.Generator) -> Futures:
        """See :class:`World`; the generator is not used."""
        domain, number = self.domain, len(self.domain.actions)
        now = {name: value[None, None] for name, value in past.now.items()}
        state = domain.state_behind(now)
        observations, rewards = [now], []
        for step in range(horizon):
            parent, action = _children(number**step, number, past.actions.device)
            before, action = _select(state, parent), action[None]
            state = domain.transition(before, action)
            rewards.append(total_reward(domain.rewards(before, action, state)))
            if step < horizon - 1:
                observations.append(domain.observe(state))
        return Futures(observations, rewards)


class SelfModelWorld:
    """The robot's own latent states, rolled forward by what it has learned.

    ``z_t`` comes from the encoder, which sees everything; then ``p(z_{t+1} | z_t, a_t)``,
    ``p(x_t | z_t)`` and ``p(r_t | z_t, a_t)``. Observations are the decoders' means, moved to the
    nearest that can be; rewards are means too.

    Args:
        self_model: the robot's networks.
        draws: number of draws W of states; one means that every state is the mean.
    """

    def __init__(self, self_model: SelfModel, draws: int = 1) -> None:
        if draws < 1:
            raise ValueError(f"draws must be at least 1, not {draws}")
        self.self_model = self_model
        self.draws = draws

    def futures(self, past: RoundSoFar, horizon: int, generator: torch.Generator) -> Futures:
        """See :class:`World`."""
        model, number = self.self_model, len(self.self_model.domain.actions)
        latent = self._drawn(robot_belief(model, past), (self.draws, 1), generator)
        observations = [
            {
                name: value[None, None].expand(self.draws, 1, *value.shape)
                for name, value in past.now.items()
            }
        ]
        rewards = []
        for step in range(horizon):
            parent, action = _children(number**step, number, past.actions.device)
            before, action = latent[:, parent], action.expand(self.draws, -1)
            rewards.append(model.reward(before, action).mean)
            if step < horizon - 1:
                latent = self._drawn(model.transition(before, action), (), generator)
                observations.append(model.domain.nearest(model.decode(latent)))
        return Futures(observations, rewards)

    def _drawn(self, state: Gaussian, batch: tuple[int, ...], generator: torch.Generator) -> Tensor:
        mean = state.mean.expand(*batch, *state.mean.shape)
        if self.draws == 1:
            return mean
        noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
        return mean + state.scale * noise


def robot_belief(self_model: SelfModel, past: RoundSoFar) -> Gaussian:
    """``q(z^R_t | ...)`` of the robot, which sees everything; parameters ``[Z]``."""
    encoder, domain = self_model.encoder, self_model.domain
    everything = {
        m.name: torch.ones_like(past.observation[m.name][..., 0], dtype=torch.bool)
        for m in domain.modalities
    }
    evidence = self_model.evidence(past.observation, everything, past.actions)
    before = evidence.new_zeros(self_model.latent)
    if past.time > 0:
        before = self_model.believe(evidence[:-1])[-1]
    return encoder(before, evidence[-1])


def _children(paths: int, actions: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Parent path and last action of every path of one action more, ``[paths * A]`` each."""
    child = torch.arange(paths * actions, device=device)
    return child // actions, child % actions


def _select(state: Any, paths: Tensor) -> Any:
    """The states ``[W, len(paths)]`` of some paths."""
    return type(state)(**{name: value[:, paths] for name, value in vars(state).items()})

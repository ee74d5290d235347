"""The world's part of the human program: the self-model's states, observations and rewards.

Given recordings, these sites do not depend on implants, so engines leave them out. Run forward they
take the place of a simulator::

    z_0 ~ q(z_0 | x_0)                      rounds begin with the first observation
    z_t ~ p(z_t | z_{t-1}, a_{t-1}),   x^m_t ~ p(x^m_t | z_t),   r_t ~ p(r_t | z_t, a_t)
"""

from __future__ import annotations

from typing import Any

import pyro
import pyro.distributions as dist
import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from mirror_ppl.domains.base import Observation
from mirror_ppl.models.self_model import SelfModel

ACTION, OBSERVATION = "action_", "observation_"
"""Prefixes of the names of these sites."""


def first_state(self_model: SelfModel, observation: Observation) -> Tensor:
    """Sample ``z_0`` ``[..., Z]`` of rounds that begin with observations ``[..., K, F]``."""
    everything = {
        m.name: torch.ones_like(observation[m.name][..., 0], dtype=torch.bool)
        for m in self_model.domain.modalities
    }
    encoder = self_model.encoder
    evidence = encoder.combine(encoder.embed(self_model.domain.symbols(observation)), everything)
    none = torch.tensor(len(self_model.domain.actions), device=evidence.device)
    before = evidence.new_zeros(*evidence.shape[:-1], self_model.latent)
    mean, scale = encoder(before, evidence + encoder.action(none))
    return pyro.sample("state", dist.Normal(mean, scale).to_event(1))


def next_state(
    self_model: SelfModel, state: Tensor, action: Tensor, recorded: Observation
) -> tuple[Tensor, Observation]:
    """Sample ``z_t`` ``[..., Z]``, and sample or observe ``x_t``, in the domain's units.

    Args:
        self_model: the robot's.
        state: ``z_{t-1}``, ``[..., Z]``.
        action: ``a_{t-1}``, ``[...]``.
        recorded: ``x_t``, ``[..., K, F]``, to condition on.
    """
    mean, scale = self_model.transition(state, action)
    state = pyro.sample("state", dist.Normal(mean, scale).to_event(1))
    values = {}
    for name, target in self_model.targets(recorded).items():
        mean, scale = self_model.decoders[name](state)
        values[name] = pyro.sample(
            f"observation_{name}", dist.Normal(mean, scale).to_event(2), obs=target
        )
    # Decoders are off by fractions of cells; recorded values are left as they are.
    return state, self_model.domain.nearest(self_model.in_units(values))


def reward(self_model: SelfModel, state: Tensor, action: Tensor, recorded: Tensor) -> Tensor:
    """Sample or observe ``r_t`` ``[...]``, in units of reward."""
    mean, scale = self_model.reward(state, action)
    return pyro.sample("reward", dist.Normal(mean, scale), obs=recorded)


class TrueWorld(Messenger):
    """Replaces the self-model's observations by the domain's own when the program runs forward.

    The observation at a step follows from the actions drawn before it::

        with TrueWorld(human.self_model, state):
            poutine.uncondition(human.model)(rounds, world=True)

    States and rewards are still those of the self-model.

    Args:
        self_model: the robot's.
        state: of the domain, in which the rounds begin, ``[P, B]``.
    """

    def __init__(self, self_model: SelfModel, state: Any) -> None:
        super().__init__()
        self.self_model, self.state = self_model, state

    def _pyro_sample(self, msg: Any) -> None:
        if msg["name"].startswith(OBSERVATION):
            name = msg["name"].removeprefix(OBSERVATION).rpartition("_")[0]
            seen = self.self_model.domain.observe(self.state)
            msg["value"], msg["done"] = self.self_model.targets(seen)[name], True

    def _pyro_post_sample(self, msg: Any) -> None:
        if msg["name"].startswith(ACTION):
            self.state = self.self_model.domain.transition(self.state, msg["value"])

"""A recurrent baseline in the place of the human model, for the same communicator.

What the network remembers is the person's belief, and what it says of actions their values::

    zH_t = h_t = GRU(h_{t-1}, [ego_t, v_t * x_t, v_t, m_t, a_{t-1}])
    v_t  = what the setting lets an unaided person see, or what they are told; m_t the latter alone
    a_t ~ Categorical(softmax(y(h_t)))

There is nothing to infer any more: training made a point estimate of the network.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.baselines.inputs import network_inputs
from mirror_ppl.baselines.recurrent import RecurrentNetworks
from mirror_ppl.domains.base import Domain, Observation, Visibility
from mirror_ppl.errors import HumanModelError
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.view import View
from mirror_ppl.models.world_knowledge import WorldKnowledge

NETWORK = "network"
"""Name of the only site: which network it is, of one."""
TOLD = "told_"
"""Prefix of masks of what is told, which networks read besides what is seen."""


class NetworkPerson(HumanModel, WorldKnowledge):
    """A person as a trained network has them.

    Args:
        self_model: the robot's; it has no part in what the person does.
        networks: of one person, P = 1.
        setting: which lets them see what they see by themselves.
        world: as the robot knows it and plans in; that of the self-model unless given.

    Raises:
        HumanModelError: the networks are of several people, or of another domain.
    """

    def __init__(
        self,
        self_model: SelfModel,
        networks: RecurrentNetworks,
        setting: str,
        world: Domain | None = None,
    ) -> None:
        super().__init__(self_model)
        if len(networks.people) != 1:
            raise HumanModelError(
                f"networks of {len(networks.people)} people, expected those of one"
            )
        if networks.domain.name != self_model.domain.name:
            raise HumanModelError(
                f"networks of {networks.domain.name}, expected {self_model.domain.name}"
            )
        self.networks = networks
        self.setting = setting
        self.world = world

    @property
    def belief_size(self) -> int:
        """H, the number of the GRU's units."""
        return self.networks.hidden

    def prior(self) -> dict[str, Tensor]:
        """Which network it is: there is but one."""
        like = next(self.self_model.parameters())
        return {NETWORK: pyro.sample(NETWORK, dist.Categorical(like.new_ones(1)))}

    def draws(self, number: int) -> dict[str, Tensor]:
        """As many draws of the posterior, ``[S, 1, 1]``, which are all the same."""
        return {NETWORK: torch.zeros(number, 1, 1, dtype=torch.long)}

    def planning_domain(self, draws: Mapping[str, Tensor]) -> Domain:
        """The world that was given, or that of the self-model."""
        del draws
        return self.domain if self.world is None else self.world

    def perceive(
        self,
        implants: Implants,
        knowledge: Any,
        observation: Observation,
        told: Visibility,
        step: int,
    ) -> tuple[View, Any]:
        """What the setting shows and what is told; whatever follows is left to the network."""
        del implants, step
        seen = self.networks.visible(self.setting, observation)
        heard = {TOLD + name: mask for name, mask in told.items()}
        return View({**seen, **heard}), knowledge

    def evidence(self, view: View, observation: Observation) -> Tensor:
        """What is read at each step adds to the GRU's gates, ``[..., 3 H]``, but for the action."""
        none = torch.full(observation["ego"].shape[:-1], self._none, dtype=torch.long)
        none = none.to(observation["ego"].device)
        seen = {name: view.visible[name] for name in self._modalities}
        told = {name: view.visible[TOLD + name] for name in self._modalities}
        inputs = network_inputs(self.domain, observation, seen, told, none)
        inputs[..., -(self._none + 1) :] = 0.0
        return self.networks.gates(inputs.flatten(0, -2)[None]).view(*inputs.shape[:-1], -1)

    def believe(
        self, belief: Tensor, evidence: Tensor, action: Tensor, still: Tensor | None = None
    ) -> Tensor:
        """The state of the GRU after one step, ``[..., H]``."""
        del still
        shape = belief.shape
        gates = evidence + self.networks.weights["input"][0, -(self._none + 1) :][action]
        gates = gates.expand(*shape[:-1], -1).flatten(0, -2)[None]
        after = self.networks.update(belief.reshape(1, -1, shape[-1]), gates)
        return after.view(shape)

    def action_values(self, belief: Tensor) -> Tensor:
        """What the network says of actions, ``[..., A]``."""
        found = self.networks.outputs(belief.reshape(1, -1, belief.shape[-1]))
        return found.view(*belief.shape[:-1], -1)

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Log-probabilities of actions ``[..., P, B, A]``."""
        del implants, belief
        return values.log_softmax(-1)

    @property
    def _modalities(self) -> tuple[str, ...]:
        return tuple(modality.name for modality in self.domain.modalities)

    @property
    def _none(self) -> int:
        """A, which stands for no action."""
        return len(self.domain.actions)

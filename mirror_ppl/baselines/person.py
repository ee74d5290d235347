"""A recurrent baseline as a human model, with which the same communicator can plan.

The network's hidden state is the person's belief, and its outputs are the action values::

    zH_t = h_t = GRU(h_{t-1}, [ego_t, v_t * x_t, v_t, m_t, a_{t-1}])
    v_t  = items that the setting shows or that are communicated; m_t the latter alone
    a_t ~ Categorical(softmax(y(h_t)))

Nothing is left to infer: training gave a point estimate of the network, or an ensemble of them from
different initializations, which are equally probable::

    network ~ Categorical(1 / E, ..., 1 / E)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from mirror_ppl.baselines.inputs import Sight, look, network_inputs
from mirror_ppl.baselines.recurrent import RecurrentNetworks
from mirror_ppl.domains.base import Domain, Observation, Visibility
from mirror_ppl.errors import HumanModelError
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.view import View
from mirror_ppl.models.world_knowledge import WorldKnowledge

NETWORK = "network"
"""Name of the only site, and of the mask ``[..., E]`` of views that marks the network."""
TOLD = "told_"
"""Prefix of masks of communicated items, which networks read besides those of seen items."""


class NetworkPerson(HumanModel, WorldKnowledge):
    """A human model of one person that is a trained network, or an ensemble of E networks.

    Args:
        self_model: the robot's; it has no part in the person's actions.
        networks: E networks of one person, whose id is repeated for each.
        setting: the setting, which limits unaided sight.
        world: the world in which the robot plans; that of the self-model unless given.

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
        if len(people := {*networks.people}) != 1:
            raise HumanModelError(f"networks of {len(people)} people, expected those of one")
        if networks.domain.name != self_model.domain.name:
            raise HumanModelError(
                f"networks of {networks.domain.name}, expected {self_model.domain.name}"
            )
        self.sight: Sight = networks.sight
        self.networks = networks
        number = len(networks.people)
        alone = (networks.only(place) for place in range(number))
        self._alone = [networks] if number == 1 else list(alone)
        self.setting = setting
        self.world = world

    @property
    def belief_size(self) -> int:
        """H + E: the GRU's units, and the indicator of the network."""
        return self.networks.hidden + self._number

    def prior(self) -> dict[str, Tensor]:
        """Sample the index of the network."""
        like = next(self.self_model.parameters())
        return {NETWORK: pyro.sample(NETWORK, dist.Categorical(like.new_ones(self._number)))}

    def draws(self, number: int) -> dict[str, Tensor]:
        """Return ``number`` draws of the posterior, ``[S, 1, 1]``: each network in turn."""
        return {NETWORK: (torch.arange(number) % self._number)[:, None, None]}

    def planning_domain(self, draws: Mapping[str, Tensor]) -> Domain:
        """The world that was given, or the one that the robot was taught."""
        del draws
        return self.domain.as_believed if self.world is None else self.world

    def perceive(
        self,
        implants: Implants,
        knowledge: Any,
        observation: Observation,
        told: Visibility,
        step: int,
    ) -> tuple[View, Any]:
        """Return masks of the shown and the communicated items, and the knowledge after them."""
        del step
        seen, told, knowledge = look(
            self.domain, self.sight, self.setting, knowledge, observation, told
        )
        heard = {TOLD + name: mask for name, mask in told.items()}
        which = one_hot(implants[NETWORK], self._number) == 1
        return View({**seen, **heard, NETWORK: which}), knowledge

    def evidence(self, view: View, observation: Observation) -> Tensor:
        """Compute the part of the GRU's gates that depends on the inputs without the action.

        Returns:
            The gates' part, and the indicator of the network, ``[..., 3 H + E]``.
        """
        none = torch.full(observation["ego"].shape[:-1], self._none, dtype=torch.long)
        none = none.to(observation["ego"].device)
        seen = {name: view.visible[name] for name in self._modalities}
        told = {name: view.visible[TOLD + name] for name in self._modalities}
        inputs = network_inputs(self.domain, observation, seen, told, none)
        inputs[..., -(self._none + 1) :] = 0.0
        which = view.visible[NETWORK].expand(*inputs.shape[:-1], -1)
        gates = self._each(which, lambda networks, rows: networks.gates(rows[None])[0], inputs)
        return torch.cat([gates, which.to(gates)], -1)

    def believe(
        self, belief: Tensor, evidence: Tensor, action: Tensor, still: Tensor | None = None
    ) -> Tensor:
        """Return the GRU's state after a step, and the network's indicator, ``[..., H + E]``."""
        del still
        evidence = evidence.expand(*belief.shape[:-1], -1)
        gates, which = evidence.split([evidence.shape[-1] - self._number, self._number], -1)

        def update(networks: RecurrentNetworks, hidden: Tensor, gates: Tensor, action: Tensor):
            gates = gates + networks.weights["input"][0, -(self._none + 1) :][action]
            return networks.update(hidden[None], gates[None])[0]

        hidden = belief[..., : -self._number]
        after = self._each(which == 1, update, hidden, gates, action.expand(belief.shape[:-1]))
        return torch.cat([after, which], -1)

    def action_values(self, belief: Tensor) -> Tensor:
        """Return the network's outputs for all actions, ``[..., A]``."""
        hidden, which = belief[..., : -self._number], belief[..., -self._number :]
        return self._each(
            which == 1, lambda networks, rows: networks.outputs(rows[None])[0], hidden
        )

    def _each(self, which: Tensor, function: Callable[..., Tensor], *values: Tensor) -> Tensor:
        """Apply each row's network, marked by ``which`` ``[..., E]``, to values ``[..., N]``."""
        shape, which = which.shape[:-1], which.flatten(0, -2)
        rows = [one.reshape(len(which), *one.shape[len(shape) :]) for one in values]
        if self._number == 1:
            return function(self._alone[0], *rows).unflatten(0, shape)
        # Before the first step a belief is zero and marks no network; only its shape matters.
        number = which.long().argmax(-1)
        found = None
        for place, networks in enumerate(self._alone):
            own = (number == place).nonzero().squeeze(-1)
            made = function(networks, *(one[own] for one in rows))
            found = made.new_zeros(len(which), made.shape[-1]) if found is None else found
            found = found.index_copy(0, own, made)
        assert found is not None
        return found.unflatten(0, shape)

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Log-probabilities of actions ``[..., P, B, A]``."""
        del implants, belief
        return values.log_softmax(-1)

    @property
    def _number(self) -> int:
        """E, the number of networks."""
        return len(self._alone)

    @property
    def _modalities(self) -> tuple[str, ...]:
        return tuple(modality.name for modality in self.domain.modalities)

    @property
    def _none(self) -> int:
        """A, the index that stands for no action."""
        return len(self.domain.actions)

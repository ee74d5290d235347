"""A recurrent baseline in the place of the human model, for the same communicator.

What the network remembers is the person's belief, and what it says of actions their values::

    zH_t = h_t = GRU(h_{t-1}, [ego_t, v_t * x_t, v_t, m_t, a_{t-1}])
    v_t  = what the setting lets an unaided person see, or what they are told; m_t the latter alone
    a_t ~ Categorical(softmax(y(h_t)))

There is nothing to infer any more: training made a point estimate of the network, or several from
different beginnings, an ensemble, of which each is as probable::

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
"""Name of the only site, and of the mask ``[..., E]`` of views that tells which network it is."""
TOLD = "told_"
"""Prefix of masks of what is told, which networks read besides what is seen."""


class NetworkPerson(HumanModel, WorldKnowledge):
    """A person as a trained network has them.

    Args:
        self_model: the robot's; it has no part in what the person does.
        networks: of one person; E of them, one for each time that its id is among the people.
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
        """H, the number of the GRU's units, and E, which network it is."""
        return self.networks.hidden + self._number

    def prior(self) -> dict[str, Tensor]:
        """Which network it is."""
        like = next(self.self_model.parameters())
        return {NETWORK: pyro.sample(NETWORK, dist.Categorical(like.new_ones(self._number)))}

    def draws(self, number: int) -> dict[str, Tensor]:
        """As many draws of the posterior, ``[S, 1, 1]``: each network in turn."""
        return {NETWORK: (torch.arange(number) % self._number)[:, None, None]}

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
        del step
        seen, told, knowledge = look(
            self.domain, self.sight, self.setting, knowledge, observation, told
        )
        heard = {TOLD + name: mask for name, mask in told.items()}
        which = one_hot(implants[NETWORK], self._number) == 1
        return View({**seen, **heard, NETWORK: which}), knowledge

    def evidence(self, view: View, observation: Observation) -> Tensor:
        """What is read at each step adds to the GRU's gates, but for the action.

        Returns:
            The gates' part, and which network it is, ``[..., 3 H + E]``.
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
        """The state of the GRU after one step, and which network it is, ``[..., H + E]``."""
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
        """What the network says of actions, ``[..., A]``."""
        hidden, which = belief[..., : -self._number], belief[..., -self._number :]
        return self._each(
            which == 1, lambda networks, rows: networks.outputs(rows[None])[0], hidden
        )

    def _each(self, which: Tensor, function: Callable[..., Tensor], *values: Tensor) -> Tensor:
        """What each row's network makes of values ``[..., N]``, by ``which`` ``[..., E]``."""
        shape, which = which.shape[:-1], which.flatten(0, -2)
        rows = [one.reshape(len(which), *one.shape[len(shape) :]) for one in values]
        if self._number == 1:
            return function(self._alone[0], *rows).unflatten(0, shape)
        # Before the first step a belief is zero and nobody's; then nothing but its shape counts.
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
        """A, which stands for no action."""
        return len(self.domain.actions)

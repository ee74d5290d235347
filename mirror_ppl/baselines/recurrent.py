"""Recurrent networks of people: a separate network for each, evaluated as one batch.

The supplement's baselines share this architecture (section D)::

    h_t = GRU(h_{t-1}, [ego_t, v_t * x_t, v_t, m_t, a_{t-1}])
    y_t = output(relu(layer_L(... relu(layer_1(h_t)))))          a number for each action

``x_t`` are the domain's symbols of all items of all modalities. The mask ``v_t`` marks items that
the setting shows to an unaided person or that were communicated, ``m_t`` the latter alone. P stands
for people, H for the GRU's units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Self

import torch
from torch import Tensor, nn

from mirror_ppl.baselines.inputs import (
    Sight,
    StepInputs,
    each_step,
    input_size,
    recorded_inputs,
)
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains import Domain, require_known
from mirror_ppl.errors import DemonstrationsError

LAYER = "layer_"


class RecurrentNetworks(nn.Module):
    """Networks of P people that give a number ``y_t`` for each action, from what came before it.

    The networks share no weights.

    Args:
        domain: the world.
        people: P ids.
        sight: which items the networks read.
        weights: by name, as `initial_weights` makes them, ``[P, ...]``.
    """

    def __init__(
        self, domain: Domain, people: Sequence[str], sight: Sight, weights: Mapping[str, Tensor]
    ) -> None:
        super().__init__()
        self.domain = domain
        self.people = tuple(people)
        self.sight: Sight = sight
        self.weights = nn.ParameterDict(
            {name: nn.Parameter(value.clone()) for name, value in weights.items()}
        )
        self.layers = tuple(name for name in weights if name.removeprefix(LAYER).isdecimal())

    @property
    def hidden(self) -> int:
        """H, the number of the GRU's units."""
        return self.weights["recurrent"].shape[1]

    def inputs(self, demonstrations: Demonstrations) -> StepInputs:
        """Build the networks' inputs at each step of recorded rounds."""
        return StepInputs.of(recorded_inputs(self.domain, self.sight, demonstrations))

    def start(self, rounds: int) -> Tensor:
        """The hidden state before the first step of B rounds, ``[P, B, H]`` of zeros."""
        return self.weights["recurrent"].new_zeros(len(self.people), rounds, self.hidden)

    def step(self, hidden: Tensor, inputs: Tensor) -> Tensor:
        """Compute ``h_t`` ``[P, B, H]`` from ``h_{t-1}`` and ``inputs`` ``[P, B, I]``."""
        return self.update(hidden, self.gates(inputs))

    def outputs(self, hidden: Tensor) -> Tensor:
        """Compute ``y_t`` ``[P, B, A]`` from hidden states ``[P, B, H]``."""
        own, values = self.weights, hidden
        for name in self.layers:
            values = torch.relu(torch.baddbmm(own[f"{name}_bias"], values, own[name]))
        return torch.baddbmm(own["output_bias"], values, own["output"])

    def forward(self, inputs: StepInputs) -> Tensor:
        """Compute ``y_t`` at every step, ``[P, B, T, A]``."""
        _, rounds, steps = inputs.place.shape
        gates = each_step(self.gates(inputs.rows), inputs.place)
        hidden, states = self.start(rounds), []
        for gate in gates.unbind(2):
            hidden = self.update(hidden, gate)
            states.append(hidden)
        return self.outputs(torch.stack(states, 2).flatten(1, 2)).unflatten(1, (rounds, steps))

    def act(self, hidden: Tensor) -> Tensor:
        """Log-probabilities of the actions ``[P, B, A]`` in hidden states ``[P, B, H]``."""
        return self.outputs(hidden).log_softmax(-1)

    @torch.no_grad()
    def log_probabilities(self, demonstrations: Demonstrations) -> Tensor:
        """Log-probabilities in nats of all actions at every step, ``[P, B, T, A]``.

        Each depends only on what came before the action. In padding they are meaningless.

        Args:
            demonstrations: rounds of some of the people, in any order; P is their number.

        Raises:
            DemonstrationsError: they are of another domain.
            UnknownNameError: a person has no network here.
        """
        own = self.of(demonstrations)
        return own(own.inputs(demonstrations)).log_softmax(-1)

    def of(self, demonstrations: Demonstrations) -> Self:
        """Select the networks of the recorded people, in their order; errors as above."""
        if demonstrations.domain != self.domain.name:
            raise DemonstrationsError(
                f"demonstrations of {demonstrations.domain}, expected {self.domain.name}"
            )
        if demonstrations.people == self.people:
            return self
        return self.only(
            *(
                self.people.index(require_known(person, "person", self.people))
                for person in demonstrations.people
            )
        )

    def only(self, *numbers: int) -> Self:
        """Select the networks of people by index."""
        weights = {name: value[list(numbers)] for name, value in self.weights.items()}
        people = [self.people[number] for number in numbers]
        return type(self)(self.domain, people, self.sight, weights)

    def shared_by(self, people: Sequence[str]) -> Self:
        """Use the single network for each of several people."""
        weights = {
            name: value.expand(len(people), *value.shape[1:])
            for name, value in self.weights.items()
        }
        return type(self)(self.domain, people, self.sight, weights)

    @classmethod
    def ensemble(cls, members: Sequence[Self], number: int) -> Self:
        """Collect the networks of one person, by index, from several trainings."""
        each = [networks.only(number) for networks in members]
        weights = {name: torch.cat([one.weights[name] for one in each]) for name in each[0].weights}
        people = [one.people[0] for one in each]
        return cls(each[0].domain, people, each[0].sight, weights).requires_grad_(False)

    def gates(self, inputs: Tensor) -> Tensor:
        """Compute the inputs' part ``[P, N, 3 H]`` of the gates from ``inputs`` ``[P, N, I]``."""
        # Most symbols never occur in a batch, and columns of zeros add nothing.
        used = inputs.flatten(0, -2).any(0)
        weight = self.weights["input"][:, used]
        return torch.baddbmm(self.weights["input_bias"], inputs[..., used], weight)

    def update(self, hidden: Tensor, gates: Tensor) -> Tensor:
        """Compute ``h_t`` ``[P, B, H]`` from ``h_{t-1}`` and the inputs' part of :meth:`gates`."""
        own = torch.baddbmm(self.weights["recurrent_bias"], hidden, self.weights["recurrent"])
        size = 2 * self.hidden
        reset, keep = torch.sigmoid(gates[..., :size] + own[..., :size]).chunk(2, -1)
        new = torch.tanh(gates[..., size:] + reset * own[..., size:])
        return new + keep * (hidden - new)


def initial_weights(
    domain: Domain,
    hidden: int,
    layers: Sequence[int],
    generators: Sequence[torch.Generator],
) -> dict[str, Tensor]:
    """Weights ``[P, inputs, outputs]`` and biases ``[P, 1, outputs]`` of each layer by name.

    The GRU and the layers are initialized as in torch. Input weights are zero, so that a symbol
    that recordings lack adds nothing; so is the output's bias.

    Args:
        domain: the world.
        hidden: units of the GRU.
        layers: units of each layer after it.
        generators: one for each of P people.
    """
    actions = len(domain.actions)
    shapes = {
        "recurrent": (hidden, 3 * hidden, hidden),
        "recurrent_bias": (1, 3 * hidden, hidden),
        "input_bias": (1, 3 * hidden, hidden),
    }
    before = hidden
    for place, size in enumerate(layers, 1):
        name = f"{LAYER}{place}"
        shapes |= {name: (before, size, before), f"{name}_bias": (1, size, before)}
        before = size
    shapes["output"] = (before, actions, before)
    weights = {}
    for name, (rows, columns, fan_in) in shapes.items():
        drawn = torch.stack([torch.rand(rows, columns, generator=own) for own in generators])
        weights[name] = (2 * drawn - 1) * fan_in**-0.5
    weights["input"] = torch.zeros(len(generators), input_size(domain), 3 * hidden)
    weights["output_bias"] = torch.zeros(len(generators), 1, actions)
    return weights

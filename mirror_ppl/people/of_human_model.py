"""People who follow a human model with known implants, such as draws from its prior."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import pyro
import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain, Observation, Visibility, map_state
from mirror_ppl.errors import HumanModelError
from mirror_ppl.models.belief_tracking import BeliefState, Transition
from mirror_ppl.models.human import HumanModel, require_standard_program
from mirror_ppl.models.prior import draw_prior_of_each
from mirror_ppl.models.simulation import true_values
from mirror_ppl.people.base import SimulatedPeople
from mirror_ppl.randomness import forked, person_id


@dataclass(frozen=True)
class Mind:
    """Beliefs, knowledge and last actions of people.

    Attributes:
        belief: ``[P, ..., Z]``.
        action: ``[P, ...]``; the number of actions before the first one.
        time: number of steps so far, the same for all, ``[P, ...]``.
        knowledge: of the human model, ``[P, ...]``.
    """

    belief: Tensor
    action: Tensor
    time: Tensor
    knowledge: Any


@dataclass(frozen=True)
class PeopleOfHumanModel(SimulatedPeople):
    """P people who follow a human model.

    Attributes:
        human: the model.
        implants: values of all sites, ``[P, 1, ...]``.

    Raises:
        HumanModelError: the model overrides the program itself, or what people see is drawn anew
            in each round.
    """

    human: HumanModel
    implants: dict[str, Tensor]

    def __post_init__(self) -> None:
        require_standard_program(self.human, "be played step by step")
        if self.human.has_round_latents:
            name = type(self.human).__name__
            raise HumanModelError(
                f"people of {name} cannot be played step by step: it has round_latents, which are "
                "drawn anew in each round"
            )

    @property
    def domain(self) -> Domain:
        """World in which they act."""
        return self.human.domain

    @property
    def number(self) -> int:
        """P."""
        return len(next(iter(self.implants.values())))

    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Mind:
        """Return memories before a round begins."""
        del mind_noise
        shape, like = (self.number, *batch), next(self.human.parameters())
        whole = torch.zeros(shape, dtype=torch.long, device=like.device)
        knowledge = self.human.nothing_known(whole.numel(), device=like.device)
        return Mind(
            like.new_zeros(*shape, self.human.belief_size),
            whole + len(self.domain.actions),
            whole,
            map_state(lambda part: part.unflatten(0, shape), knowledge),
        )

    @torch.no_grad()
    def sees(self, observation: Observation) -> Visibility:
        """Return items that each would see at a first step."""
        shape = observation["ego"].shape[:-1]
        flat = {name: value.flatten(0, len(shape) - 1) for name, value in observation.items()}
        found = self.human.sees(self._of_each(shape), flat, 0)
        return {name: mask.unflatten(0, shape) for name, mask in found.items()}

    @torch.no_grad()
    def step(
        self, memory: Mind, observation: Observation, told: Visibility | None = None
    ) -> tuple[Tensor, Mind]:
        """Perceive, believe and choose as the program does."""
        shape = memory.action.shape
        last, number = len(shape) - 1, memory.action.numel()

        def flat(part: Tensor) -> Tensor:
            return part.flatten(0, last)

        seen = {name: flat(value) for name, value in observation.items()}
        if told is None:
            told = {
                m.name: torch.zeros(
                    *shape, len(m.items), dtype=torch.bool, device=memory.action.device
                )
                for m in self.domain.modalities
            }
        every = torch.arange(number, device=memory.action.device)
        before = BeliefState(
            self.human,
            flat(memory.belief),
            None,
            every,
            map_state(flat, memory.knowledge),
            int(memory.time.flatten()[0]),
        )
        heard = {name: flat(mask.expand(*shape, -1)) for name, mask in told.items()}
        transition = Transition(self._of_each(shape), flat(memory.action), seen, heard, every)
        with forked(), pyro.plate("person", self.number, dim=-2):
            after = before.after(transition)
            belief = after.believed.view(self.number, -1, self.human.belief_size)
            chosen = self.human.act(self.implants, belief, self.human.action_values(belief))
        return chosen.exp().view(*shape, -1), Mind(
            belief.view(memory.belief.shape),
            memory.action,
            memory.time + 1,
            map_state(lambda part: part.unflatten(0, shape), after.knowledge),
        )

    def acted(self, memory: Mind, action: Tensor) -> Mind:
        """Return the memory with the chosen action."""
        return replace(memory, action=action)

    def truth(self) -> dict[str, Tensor]:
        """Return the values of all sites that are one number."""
        return true_values(self.human, {name: part[None] for name, part in self.implants.items()})

    def modelled(self) -> tuple[HumanModel, dict[str, Tensor]]:
        """Return the human model, with all implants."""
        return self.human, {name: value[None] for name, value in self.implants.items()}

    def select(self, index: list[int]) -> Self:
        """Return some of these people."""
        return replace(self, implants={name: part[index] for name, part in self.implants.items()})

    @classmethod
    def join(cls, people: Sequence[Self]) -> Self:
        """Return people of one human model together."""
        first = people[0]
        implants = {
            name: torch.cat([one.implants[name] for one in people]) for name in first.implants
        }
        return replace(first, implants=implants)

    def _of_each(self, shape: Sequence[int]) -> dict[str, Tensor]:
        """Return implants of each of the rounds of a shape ``[P, ...]``, side by side."""
        rounds = math.prod(shape[1:])
        return {
            name: value.expand(self.number, rounds, *value.shape[2:]).flatten(0, 1)
            for name, value in self.implants.items()
        }


def people_from_prior(human: HumanModel, people: int, seed: int) -> PeopleOfHumanModel:
    """Return people drawn from a human model's prior; each does not depend on how many they are.

    Args:
        human: the model.
        people: number of people P.
        seed: of the draws.

    Raises:
        HumanModelError: as for :class:`PeopleOfHumanModel`.
    """
    drawn = draw_prior_of_each(human, [person_id(place) for place in range(people)], 1, seed)
    return PeopleOfHumanModel(human, {name: value[0] for name, value in drawn.items()})

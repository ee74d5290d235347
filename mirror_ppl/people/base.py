"""Base classes of simulated people, who look, listen, remember and choose."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain, Observation, Visibility, map_state

if TYPE_CHECKING:
    from mirror_ppl.models.human import HumanModel


@dataclass(frozen=True)
class DomainPeople:
    """The simulated people of a domain.

    Attributes:
        populations: names of the populations.
        simulated: makes people from setting, population, number, seed and device.
        oracle: maps one person and the initial states of rounds to a function from actions
            ``[R, t]`` to the best messages ``[R, items]``; unless given, the oracle enumerates
            reachable states (:mod:`mirror_ppl.evaluation.reachable_oracle`).
        best_messages: a greedy oracle, where states are too many for that: maps one person, the
            true states ``[1, R]`` and their memories ``[1, R]`` to messages ``[R, items]``.
    """

    populations: tuple[str, ...]
    simulated: Callable[..., SimulatedPeople]
    oracle: Callable[[Any, Any], Callable[[Tensor], Tensor]] | None = None
    best_messages: Callable[[Any, Any, Any], Tensor] | None = None


@dataclass(frozen=True)
class SimulatedPeople(ABC):
    """P people who act in a domain; step them with `step`.

    They have no state between calls: the memory is an argument and a result, so that one person can
    be simulated along many histories at once. A memory is a dataclass of tensors, all of which
    begin with the dimensions of the rounds.

    Attributes:
        mind_noises: number of uniform numbers per round for random events in a person's mind, apart
            from choices of actions.
    """

    mind_noises: ClassVar[int] = 0

    @property
    @abstractmethod
    def domain(self) -> Domain:
        """World in which they act."""

    @abstractmethod
    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Any:
        """Return memories ``[P, *batch, ...]`` before a round begins.

        Args:
            batch: rounds.
            mind_noise: uniform numbers ``[P, *batch, mind_noises]``; unless given, the most
                probable events happen.
        """

    @abstractmethod
    def sees(self, observation: Observation) -> Visibility:
        """Return items each perceives without messages, boolean ``[P, ..., K]`` by modality.

        Args:
            observation: full observation, ``[P, ...]``.
        """

    @abstractmethod
    def step(
        self, memory: Any, observation: Observation, told: Visibility | None = None
    ) -> tuple[Tensor, Any]:
        """Look, listen, remember, plan.

        Args:
            memory: of the step before, ``[P, ...]``; `start` at the first step of a round.
            observation: full observation, ``[P, ...]``.
            told: boolean ``[P, ..., K]`` for each modality, the items communicated at this step.

        Returns:
            Probabilities of the actions ``[P, ..., A]`` and the memory at this step.
        """

    def branches(
        self, memory: Any, observation: Observation, told: Visibility
    ) -> tuple[Tensor, Any, Tensor]:
        """Return all memories that a step can lead to, where random events decide.

        Args:
            memory: as for `step`.
            observation: as for `step`.
            told: as for `step`.

        Returns:
            Probabilities ``[P, ..., G]`` of G memories, these memories ``[P, ..., G, ...]``, and
            probabilities of the actions of each ``[P, ..., G, A]``.
        """
        probability, after = self.step(memory, observation, told)
        dimensions = probability.dim() - 1
        return (
            torch.ones_like(probability[..., :1]),
            map_state(lambda part: part.unsqueeze(dimensions), after),
            probability[..., None, :],
        )

    def acted(self, memory: Any, action: Tensor) -> Any:
        """Return the memory after an action ``[P, ...]`` was chosen; unchanged by default."""
        del action
        return memory

    def kept(self, memory: Any) -> Any:
        """Return a memory without its random numbers: what is known and wanted."""
        return memory

    @abstractmethod
    def truth(self) -> dict[str, Tensor]:
        """Return true values ``[P]`` by the names of the sites that infer them."""

    def provenance(self) -> dict[str, str]:
        """Return provenance for recordings, besides population and seed."""
        return {}

    def modelled(self) -> tuple[HumanModel, dict[str, Tensor]] | None:
        """Return a human model and values ``[1, P, 1, ...]`` of its sites that equal these people.

        ``None`` if no human model equals them.
        """
        return None

    def predictive(
        self, probabilities: Tensor, observation: Observation, actions: Tensor, told: Visibility
    ) -> Tensor:
        """Return probabilities ``[P, B, T, A]`` of actions, given the history before each.

        They differ from those of `step` where memories have latent random parts.

        Args:
            probabilities: of each step, given the memory, ``[P, B, T, A]``.
            observation: full observations, ``[P, B, T + 1, ...]``.
            actions: actions, ``[P, B, T]``.
            told: communicated items, ``[P, B, T, K]``.
        """
        del observation, actions, told
        return probabilities

    def select(self, index: list[int]) -> Self:
        """Return some of these people, ``[len(index)]``."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return type(self)(
            **{
                name: part[index] if isinstance(part, Tensor) else part
                for name, part in parts.items()
            }
        )

    @classmethod
    def join(cls, people: Sequence[Self]) -> Self:
        """Return people of one population together; undoes `select`.

        What differs between them has to be in tensors; other fields are those of the first.
        """
        first, *others = people
        if not others:
            return first
        return type(first)(
            **{
                field.name: torch.cat([getattr(one, field.name) for one in people])
                if isinstance(part := getattr(first, field.name), Tensor)
                else part
                for field in fields(first)
            }
        )


def act(probability: Tensor, action_noise: Tensor) -> Tensor:
    """Choose actions ``[...]`` with probabilities ``[..., A]`` by uniform numbers ``[...]``.

    Small numbers choose late actions: of two, the second where the noise is below its probability.
    """
    beyond = probability.flip(-1).cumsum(-1).flip(-1)[..., 1:]
    return (action_noise[..., None] < beyond).sum(-1)


def each(value: Tensor, dimensions: int) -> Tensor:
    """Insert dimensions after the first, so that people broadcast over later dimensions."""
    return value.reshape(value.shape[0], *[1] * dimensions, *value.shape[1:])

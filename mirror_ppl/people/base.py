"""What simulated people have in common: they look, listen, remember and choose."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable
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
        populations: names of who they may be.
        simulated: makes them, of setting, population, number, seed and device.
        oracle: of one person and the states in which rounds begin, what says ``[R, items]`` what is
            best after actions ``[R, t]``; unless given it is sought in every state that can be
            reached (:mod:`mirror_ppl.evaluation.reachable_oracle`).
    """

    populations: tuple[str, ...]
    simulated: Callable[..., SimulatedPeople]
    oracle: Callable[[Any, Any], Callable[[Tensor], Tensor]] | None = None


@dataclass(frozen=True)
class SimulatedPeople(ABC):
    """P people who act in a domain; step them with `step`.

    Nothing is kept between calls: the memory goes in and comes out, so that one person can be led
    through many courses of a round at once. A memory is a dataclass of tensors, all of which begin
    with the dimensions of the rounds.

    Attributes:
        mind_noises: how many uniform numbers, drawn as a round begins, decide what is random in a
            person's mind; choices of actions are not among them.
    """

    mind_noises: ClassVar[int] = 0

    @property
    @abstractmethod
    def domain(self) -> Domain:
        """The world that they act in."""

    @abstractmethod
    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Any:
        """Memory ``[P, *batch, ...]`` before a round begins.

        Args:
            batch: rounds.
            mind_noise: uniform numbers ``[P, *batch, mind_noises]``; unless given, the most
                probable happens.
        """

    @abstractmethod
    def sees(self, observation: Observation) -> Visibility:
        """What each sees and hears by themselves, boolean ``[P, ..., K]`` for each modality.

        Args:
            observation: ``[P, ...]``, everything there is to observe.
        """

    @abstractmethod
    def step(
        self, memory: Any, observation: Observation, told: Visibility | None = None
    ) -> tuple[Tensor, Any]:
        """Look, listen, remember, plan.

        Args:
            memory: of the step before, ``[P, ...]``; `start` at the first step of a round.
            observation: ``[P, ...]``, everything there is to observe.
            told: boolean ``[P, ..., K]`` for each modality, the items communicated at this step.

        Returns:
            Probabilities of the actions ``[P, ..., A]`` and the memory at this step.
        """

    def branches(
        self, memory: Any, observation: Observation, told: Visibility
    ) -> tuple[Tensor, Any, Tensor]:
        """Everything that a step can lead to in their minds, where that is chance.

        Args:
            memory: as for `step`.
            observation: as for `step`.
            told: as for `step`.

        Returns:
            Chances ``[P, ..., G]`` of G minds, these ``[P, ..., G, ...]``, and probabilities of the
            actions of each ``[P, ..., G, A]``.
        """
        probability, after = self.step(memory, observation, told)
        dimensions = probability.dim() - 1
        return (
            torch.ones_like(probability[..., :1]),
            map_state(lambda part: part.unsqueeze(dimensions), after),
            probability[..., None, :],
        )

    def acted(self, memory: Any, action: Tensor) -> Any:
        """The memory once an action ``[P, ...]`` was chosen; people need not keep it in mind."""
        del action
        return memory

    def kept(self, memory: Any) -> Any:
        """Of a memory what is known and wanted, without the numbers that decide what is chance."""
        return memory

    @abstractmethod
    def truth(self) -> dict[str, Tensor]:
        """What is true of each ``[P]``, by the names of the sites that infer it."""

    def provenance(self) -> dict[str, str]:
        """What recordings say of how these people were made, besides population and seed."""
        return {}

    def modelled(self) -> tuple[HumanModel, dict[str, Tensor]] | None:
        """A human model, and values ``[1, P, 1, ...]`` of its sites with which it is these people.

        ``None`` if they are of another kind.
        """
        return None

    def predictive(
        self, probabilities: Tensor, observation: Observation, actions: Tensor, told: Visibility
    ) -> Tensor:
        """Probabilities ``[P, B, T, A]`` of actions given everything but the action noise.

        They differ from those of `step` where people have something in mind that cannot be seen.

        Args:
            probabilities: of each step, given what they had in mind, ``[P, B, T, A]``.
            observation: what there was to observe, ``[P, B, T + 1, ...]``.
            actions: what was done, ``[P, B, T]``.
            told: what was communicated, ``[P, B, T, K]``.
        """
        del observation, actions, told
        return probabilities

    def select(self, index: list[int]) -> Self:
        """Some of these people, ``[len(index)]``."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return type(self)(
            **{
                name: part[index] if isinstance(part, Tensor) else part
                for name, part in parts.items()
            }
        )


def act(probability: Tensor, action_noise: Tensor) -> Tensor:
    """Actions ``[...]`` that uniform numbers ``[...]`` choose with probabilities ``[..., A]``.

    Small numbers choose late actions: of two, the second where the noise is below its probability.
    """
    beyond = probability.flip(-1).cumsum(-1).flip(-1)[..., 1:]
    return (action_noise[..., None] < beyond).sum(-1)


def each(value: Tensor, dimensions: int) -> Tensor:
    """Insert dimensions behind the first, so that people broadcast over what follows."""
    return value.reshape(value.shape[0], *[1] * dimensions, *value.shape[1:])


def derived_generator(
    seed: int, *purpose: str | int, device: torch.device | str = "cpu"
) -> torch.Generator:
    """A generator of its own for each seed and purpose.

    Hashed rather than added up, so that neighbouring seeds share nothing.
    """
    text = "/".join(map(str, (seed, *purpose)))
    digest = hashlib.blake2b(text.encode(), digest_size=8).digest()
    # Torch's seeds are signed.
    return torch.Generator(device).manual_seed(int.from_bytes(digest) >> 1)

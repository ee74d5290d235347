"""Simulated drivers: what they know of cars around them, and what they do.

A driver knows the cars within reach, those that were shown or spoken of, and for some time those
remembered (:mod:`mirror_ppl.domains.highway.knowledge`). They plan among these as the expert does
in the true world, with a weight of their own on coming near others and on accidents, and choose
more or less consistently:

``p(a_t | m_t) = softmax(consistency * Q(., m_t))``

with ``Q(a, m_t)`` the return of keeping up manoeuvre ``a`` for six seconds among the cars known.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain, Observation, Visibility, by_eye
from mirror_ppl.domains.highway import expert
from mirror_ppl.domains.highway.estimate import Cars, state_with
from mirror_ppl.domains.highway.knowledge import Memory, nothing, once_each, remember
from mirror_ppl.domains.highway.world import SIGHT_OF, Highway
from mirror_ppl.models.implants import ASSUMES, SIGHT
from mirror_ppl.people.base import SimulatedPeople

CAREFUL = ("front_proximity", "back_proximity", "near", "accident")
"""Terms of the reward that are weighted by a driver's caution."""


@dataclass(frozen=True)
class HighwayDrivers(SimulatedPeople):
    """P simulated drivers; step them with `step`.

    Attributes:
        reach: metres that each sees ``[P, 4]``, in each of ``Highway.directions``.
        consistency: ``[P]``, in 1 / units of reward.
        caution: weight ``[P]`` of ``CAREFUL`` terms, relative to the task's.
    """

    reach: Tensor
    consistency: Tensor
    caution: Tensor

    @property
    def domain(self) -> Domain:
        """World in which they act."""
        return Highway()

    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Memory:
        """Return memories before a round begins."""
        del mind_noise
        return nothing(len(self.reach), *batch, like=self.reach)

    def sees(self, observation: Observation) -> Visibility:
        """Return sectors within reach."""
        direction, distance = self.domain.distance(observation)
        people = torch.arange(len(self.reach), device=distance.device).view(
            -1, *(1,) * (distance.dim() - 1)
        )
        return by_eye(self.domain, distance <= self.reach[people, direction])

    @torch.no_grad()
    def step(
        self, memory: Memory, observation: Observation, told: Visibility | None = None
    ) -> tuple[Tensor, Memory]:
        """Look, listen, remember, and plan among the cars that are known."""
        seen = self.sees(observation)["visual"]
        heard = torch.zeros_like(memory.there)
        if told is not None:
            seen, heard = seen | told["visual"], heard | told["verbal"]
        limits = self._limits(observation["ego"])
        memory = remember(memory, observation, seen, heard, lambda distance: distance > limits)
        lengths = (1,) * (memory.x.dim() - 2)
        parts = [(getattr(memory, part.name), 1) for part in fields(Cars)]
        caution = self.caution.view(-1, *lengths, 1)
        # Messages that tell a driver nothing new lead to the same cars.
        values = once_each(_values, (observation["ego"], 1), (caution, 1), *parts)
        return torch.softmax(self.consistency.view(-1, *lengths, 1) * values, -1), memory

    def _limits(self, ego: Tensor) -> Tensor:
        """Return the reach ``[P, ..., 6]`` in each direction of speech."""
        reach = self.reach[:, list(SIGHT_OF)]
        return reach.view(len(reach), *(1,) * (ego.dim() - 2), -1).expand(*ego.shape[:-1], -1)

    def truth(self) -> dict[str, Tensor]:
        """Return their sight thresholds, and that they take for granted what they do not see."""
        own = {SIGHT + name: self.reach[:, i] for i, name in enumerate(self.domain.directions)}
        return own | {ASSUMES + "clear": torch.ones_like(self.consistency)}


def _values(ego: Tensor, caution: Tensor, *cars: Tensor) -> Tensor:
    """Return the return ``[n, A]`` of each manoeuvre among cars ``[n, 6]``, fields of `Cars`."""
    state = state_with(ego, Cars(*cars))
    return expert.values(state, weights=dict.fromkeys(CAREFUL, caution[:, 0]))

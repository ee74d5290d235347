"""Views of training rounds: modality and item dropout for the self-model.

One encoder has to serve the robot, which sees everything, and people, who see less and interpret it
differently. Each training round is therefore seen through a randomly drawn view of three kinds:

- *full*: everything, in both modalities;
- *dropout*: each item with a probability drawn for the round, in each modality;
- *sight*: items within a reach drawn for each direction; in worlds where noticing takes time, each
  is noticed at each step with a probability drawn for the round. Some rounds include messages.

An observer with a sight view has memory: what follows from earlier observations and messages counts
as visible. They may also make assumptions, such as that a car never seen is not there. For such a
round the world is replaced by the believed one, so that the encoder learns what such an observer
would conclude; an item that is merely not visible stays unobserved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain, Observation, Visibility

KINDS = ("full", "dropout", "sight")
KIND_PROBABILITIES = (0.1, 0.1, 0.8)
ASSUMPTION_PROBABILITY = 0.7
"""Share of sight views in which each assumption is made."""
TOLD_PROBABILITY = 0.4
ALIKE_PROBABILITY = 0.5
"""Share of sight views with the same reach in all directions of a group, as most people have."""


@dataclass(frozen=True)
class ViewPlan:
    """Views of B rounds; a plan can be applied to any course of a round.

    Attributes:
        reach: sight threshold for each direction ``[B, D]``, in the domain's unit of distance; the
            last of the domain's ``reach_bins`` is everything.
        keep: for each modality, the probability ``[B]`` that an item within reach is visible.
        told: for each modality, the probability ``[B]`` that a communicable item is communicated.
        remembers: ``[B]``, True if what follows from earlier observations counts as visible.
        assumes: for each of the domain's assumptions, True where it is made, ``[B]``.
        noise: for each modality, uniform numbers ``[B, T + 1, K, 2]`` that decide keep and told.
    """

    reach: Tensor
    keep: Visibility
    told: Visibility
    remembers: Tensor
    assumes: dict[str, Tensor]
    noise: dict[str, Tensor]

    def sees(
        self, domain: Domain, observation: Observation, first: int = 0, stride: int = 1
    ) -> Visibility:
        """Items seen without messages ``[B, T', K]``, of observations ``[B, T', ...]``."""
        direction, distance = domain.distance(observation)
        batch = torch.arange(len(self.reach), device=self.reach.device)[:, None, None]
        seen = {
            name: torch.ones_like(value[..., 0], dtype=torch.bool)
            for name, value in observation.items()
            if name != "ego"
        }
        everything = self.reach >= torch.tensor(domain.reach_bins[-1:]).to(self.reach)
        limits = self.reach.masked_fill(everything, torch.inf)
        seen["visual"] = distance <= limits[batch, direction]
        steps = slice(first, first + stride * distance.shape[1], stride)
        return {
            name: near & (self.noise[name][:, steps, :, 0] < self.keep[name][:, None, None])
            for name, near in seen.items()
        }

    def visibility(
        self, domain: Domain, observation: Observation, first: int = 0, stride: int = 1
    ) -> Visibility:
        """Items seen or communicated ``[B, T', K]``, of observations from step ``first`` on."""
        communicable = domain.communicable(observation)
        visible = self.sees(domain, observation, first, stride)
        for name, seen in visible.items():
            noise = self.noise[name][:, first : first + stride * seen.shape[1] : stride, :, 1]
            visible[name] = seen | (communicable[name] & (noise < self.told[name][:, None, None]))
        return visible

    def look(
        self, domain: Domain, knowledge: Any, observation: Observation, first: int, stride: int = 1
    ) -> tuple[Visibility, Any]:
        """Compute visibility and the updated knowledge at some steps.

        Args:
            domain: the world.
            knowledge: before each of these steps, ``[B, T']``.
            observation: ``[B, T', ...]``, from step ``first`` on.
            first: number of the first of these steps.
            stride: distance between these steps.

        Returns:
            Masks ``[B, T', K]`` of items seen, heard or remembered, and knowledge ``[B, T']``. The
            latter is updated only if something depends on it.
        """
        visible = self.visibility(domain, observation, first, stride)
        if not domain.recalls and not any(makes.any() for makes in self.assumes.values()):
            return visible, knowledge
        knowledge = domain.learn(
            knowledge,
            observation,
            visible,
            lambda supposed: self.sees(domain, supposed, first, stride),
        )
        remembered = domain.known(knowledge)
        return {
            name: mask | (remembered[name] & self.remembers[:, None, None])
            for name, mask in visible.items()
        }, knowledge

    def taken(self, domain: Domain, knowledge: Any, observation: Observation) -> Visibility:
        """Items ``[B, T', K]`` that the assumptions cover, given knowledge ``[B, T']``."""
        taken = {
            name: torch.zeros_like(value[..., 0], dtype=torch.bool)
            for name, value in observation.items()
            if name != "ego"
        }
        if not any(makes.any() for makes in self.assumes.values()):
            return taken
        items, _ = domain.assume(knowledge, observation)
        for assumption, about in items.items():
            for name, mask in about.items():
                taken[name] = taken[name] | (mask & self.assumes[assumption][:, None, None])
        return taken


def draw_views(
    domain: Domain,
    batch: int,
    steps: int,
    generator: torch.Generator,
    kinds: Sequence[float] = KIND_PROBABILITIES,
    assumed: float = ASSUMPTION_PROBABILITY,
) -> ViewPlan:
    """Draw a view for each of ``batch`` rounds of ``steps`` actions.

    Args:
        domain: the world.
        batch: number of rounds.
        steps: actions of a round.
        generator: source of randomness.
        kinds: share of rounds with a view of each of ``KINDS``.
        assumed: share of sight views in which each assumption is made.
    """
    device = generator.device

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, device=device)

    kind = torch.multinomial(torch.tensor(kinds, device=device), batch, True, generator=generator)
    full, dropout, sight = (kind == index for index in range(len(KINDS)))
    bins = torch.tensor(domain.reach_bins, device=device)
    shape = (batch, len(domain.directions))
    if domain.reach_practice:
        weights = torch.tensor(domain.reach_practice, device=device)
        drawn = torch.multinomial(weights, math.prod(shape), True, generator=generator).view(shape)
    else:
        drawn = torch.randint(len(bins), shape, generator=generator, device=device)
    alike = uniform(batch) < ALIKE_PROBABILITY
    for group in domain.direction_groups:
        for direction in group[1:]:
            drawn[:, direction] = torch.where(alike, drawn[:, group[0]], drawn[:, direction])
    least, most = domain.notice_practice
    keep, told, noise = {}, {}, {}
    spoken_to = uniform(batch) < TOLD_PROBABILITY
    for modality in domain.modalities:
        visual = modality.name == "visual"
        seen = 1.0 if visual else 0.0
        if visual and least < most:
            seen = torch.where(sight, least + (most - least) * uniform(batch), 1.0)
        rate = torch.where(dropout, uniform(batch), seen)
        keep[modality.name] = torch.where(full, 1.0, rate)
        often = domain.told_practice * uniform(batch)
        told[modality.name] = torch.where(sight & spoken_to, often, 0.0)
        noise[modality.name] = uniform(batch, steps + 1, len(modality.items), 2)
    return ViewPlan(
        reach=torch.where(sight[:, None], bins[drawn], bins[-1]),
        keep=keep,
        told=told,
        remembers=sight,
        assumes={name: sight & (uniform(batch) < assumed) for name in domain.assumptions},
        noise=noise,
    )

"""Views: who sees what of a round. Modality and item dropout for training the self-model.

One encoder has to serve the robot, which sees everything, and people, who see less and differ in
what they make of it. So each training round is seen in a way of its own, of three kinds:

- *full*: everything, in both modalities;
- *dropout*: each item with a probability drawn for the round, in each modality;
- *sight*: cars up to a reach drawn for each direction, and now and then something is told.

In a sight view the observer may be *credulous*: what they have never seen or been told of is absent
to them. For such a round the world itself is taken to be as believed, so that the encoder learns
what such an observer would conclude; an item that is merely not visible stays unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain, Observation, Visibility

KINDS = ("full", "dropout", "sight")
KIND_PROBABILITIES = (0.1, 0.1, 0.8)
CREDULOUS_PROBABILITY = 0.6
TOLD_PROBABILITY = 0.4
ALIKE_PROBABILITY = 0.5
"""Share of sight views with the same reach in all directions of a group: most people's eyes."""


@dataclass(frozen=True)
class ViewPlan:
    """How each of B rounds is seen; the same plan can be applied to any course of the round.

    Attributes:
        reach: sight threshold for each direction ``[B, D]``, in the domain's unit of distance.
        keep: for each modality, the probability ``[B]`` that an item within reach is visible.
        told: for each modality, the probability ``[B]`` that a communicable item is told.
        credulous: ``[B]``, whether never-seen items are taken to be absent.
        noise: for each modality, uniform numbers ``[B, T + 1, K, 2]`` that decide keep and told.
    """

    reach: Tensor
    keep: Visibility
    told: Visibility
    credulous: Tensor
    noise: dict[str, Tensor]

    def visibility(self, domain: Domain, observation: Observation, first: int = 0) -> Visibility:
        """What is visible ``[B, T', K]`` of observations ``[B, T', ...]`` from step ``first``."""
        direction, distance = domain.distance(observation)
        batch = torch.arange(len(self.reach), device=self.reach.device)[:, None, None]
        within = {
            modality.name: torch.ones_like(distance, dtype=torch.bool)
            for modality in domain.modalities
        }
        within["visual"] = distance <= self.reach[batch, direction]
        communicable = domain.communicable(observation)
        steps = slice(first, first + distance.shape[1])
        visible = {}
        for name, near in within.items():
            keep, told = (
                self.noise[name][:, steps].unbind(-1)[i] < probability[name][:, None, None]
                for i, probability in enumerate((self.keep, self.told))
            )
            visible[name] = (near & keep) | (communicable[name] & told)
        return visible


def draw_views(domain: Domain, batch: int, steps: int, generator: torch.Generator) -> ViewPlan:
    """Draw a view for each of ``batch`` rounds of ``steps`` actions."""
    device = generator.device

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, device=device)

    kind = torch.multinomial(
        torch.tensor(KIND_PROBABILITIES, device=device), batch, True, generator=generator
    )
    full, dropout, sight = (kind == index for index in range(len(KINDS)))
    bins = torch.tensor(domain.reach_bins, device=device)
    drawn = torch.randint(
        len(bins), (batch, len(domain.directions)), generator=generator, device=device
    )
    alike = uniform(batch) < ALIKE_PROBABILITY
    for group in domain.direction_groups:
        for direction in group[1:]:
            drawn[:, direction] = torch.where(alike, drawn[:, group[0]], drawn[:, direction])
    keep, told, noise = {}, {}, {}
    spoken_to = uniform(batch) < TOLD_PROBABILITY
    for modality in domain.modalities:
        visual = modality.name == "visual"
        rate = torch.where(dropout, uniform(batch), 1.0 if visual else 0.0)
        keep[modality.name] = torch.where(full, 1.0, rate)
        told[modality.name] = torch.where(sight & spoken_to, 0.5 * uniform(batch), 0.0)
        noise[modality.name] = uniform(batch, steps + 1, len(modality.items), 2)
    return ViewPlan(
        reach=torch.where(sight[:, None], bins[drawn], bins[-1]),
        keep=keep,
        told=told,
        credulous=sight & (uniform(batch) < CREDULOUS_PROBABILITY),
        noise=noise,
    )

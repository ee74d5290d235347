"""Inputs of the recurrent baselines at each step of a round.

Inputs are the domain's symbols of all items of all modalities, with masks of the visible and of the
communicated ones. Most rows of inputs occur at many steps, so each distinct row is kept once.

With the sight "informed", networks are given the meaning of messages, as the human model is:
communicated items count as seen, without a mask of their own, and everything that follows from
earlier observations and messages is visible (:meth:`mirror_ppl.domains.base.Domain.known`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, get_args

import torch
from torch import Tensor
from torch.nn.functional import one_hot, pad

from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains import Domain, Observation, Visibility
from mirror_ppl.models.human import at_step, messages_at
from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows

Sight = Literal["setting", "everything", "informed"]
"""Items that a network reads: those that the setting shows or that were communicated; in addition
all visual ones ("everything"), or all that follow from earlier ones ("informed").
"""
INFORMED: Sight = "informed"
"""The sight in which communicated items count as seen."""
SIGHTS: tuple[Sight, ...] = get_args(Sight)


def network_inputs(
    domain: Domain,
    observation: Observation,
    seen: Visibility,
    told: Visibility,
    previous: Tensor,
) -> Tensor:
    """Build a recurrent network's inputs ``[..., I]`` at each step; invisible items are zero.

    Args:
        domain: the world.
        observation: everything that could be observed, ego ``[..., E]`` and modalities
            ``[..., K, F]`` in the domain's units.
        seen: mask of the items that the setting shows, ``[..., K]`` for each modality.
        told: mask of the communicated items, likewise.
        previous: indices ``[...]`` of the previous actions, A where there was none.
    """
    symbols = domain.symbols(observation)
    dtype = symbols["ego"].dtype
    parts = [symbols["ego"]]
    for modality in domain.modalities:
        heard = told[modality.name]
        mask = (seen[modality.name] | heard).to(dtype)
        heard = heard.to(dtype).expand(mask.shape)
        parts += [(symbols[modality.name] * mask[..., None]).flatten(-2), mask, heard]
    parts.append(one_hot(previous, len(domain.actions) + 1).to(dtype))
    return torch.cat(parts, -1)


def visible_items(
    domain: Domain, sight: Sight, setting: str, observation: Observation
) -> Visibility:
    """Mask of the items that a setting shows to a baseline, ``[..., K]`` for each modality."""
    visible = domain.visibility(setting, observation)
    if sight == "everything":
        visible = visible | {"visual": torch.ones_like(visible["visual"])}
    return visible


def look(
    domain: Domain,
    sight: Sight,
    setting: str,
    knowledge: Any,
    observation: Observation,
    told: Visibility,
) -> tuple[Visibility, Visibility, Any]:
    """Masks of a step's items that a baseline reads as seen and as communicated, and its knowledge.

    Args:
        domain: the world.
        sight: which items are read.
        setting: the setting, which limits unaided sight.
        knowledge: the domain's knowledge after the step before; only used if informed.
        observation: everything that could be observed, ``[..., K, F]``.
        told: mask of the communicated items ``[..., K]``.
    """
    seen = visible_items(domain, sight, setting, observation)
    if sight != INFORMED:
        return seen, told, knowledge
    sees = partial(visible_items, domain, sight, setting)
    seen = {name: mask | told[name] for name, mask in seen.items()}
    knowledge = domain.learn(knowledge, observation, seen, sees)
    seen = {name: seen[name] | mask for name, mask in domain.known(knowledge).items()}
    return seen, {name: torch.zeros_like(mask) for name, mask in seen.items()}, knowledge


def recorded_inputs(domain: Domain, sight: Sight, demonstrations: Demonstrations) -> Tensor:
    """Build a baseline's inputs at each step of recorded rounds, ``[P, B, T, I]``."""
    people, rounds, steps = demonstrations.shape
    observation, told = demonstrations.observation(), dict(demonstrations.told)
    device = demonstrations.actions.device
    knowledge = domain.nothing_known(people, rounds, device=device)
    looks = []
    for step in range(steps):
        now = at_step(observation, step)
        *look_now, knowledge = look(
            domain, sight, demonstrations.setting, knowledge, now, messages_at(told, step)
        )
        looks.append(look_now)
    seen, heard = (
        {name: torch.stack([one[kind][name] for one in looks], 2) for name in told}
        for kind in range(2)
    )
    observation = {name: value[:, :, :steps] for name, value in observation.items()}
    actions = demonstrations.actions
    none = torch.full_like(actions[:, :, :1], len(domain.actions))
    # Padding has the action -1, which needs a symbol although it is not used.
    previous = torch.cat([none, actions[:, :, :-1].clamp(min=0)], 2)
    return network_inputs(domain, observation, seen, heard, previous)


def input_size(domain: Domain) -> int:
    """I, the number of inputs that `network_inputs` makes."""
    items = sum(len(m.items) * (domain.symbol_sizes[m.name] + 2) for m in domain.modalities)
    return domain.symbol_sizes["ego"] + items + len(domain.actions) + 1


@dataclass(frozen=True)
class StepInputs:
    """Inputs of P people's networks at each step of B rounds, distinct rows kept once.

    Attributes:
        rows: the N distinct rows of each person, padded with zeros ``[P, N, I]``.
        place: index of each step's row, ``[P, B, T]``.
    """

    rows: Tensor
    place: Tensor

    @classmethod
    def of(cls, inputs: Tensor) -> StepInputs:
        """Keep distinct rows of the inputs at each step, ``[P, B, T, I]``, once."""
        first, place = zip(*(_distinct(own) for own in inputs.flatten(1, 2)), strict=True)
        most = max(len(rows) for rows in first)
        rows = torch.stack([pad(rows, [0, 0, 0, most - len(rows)]) for rows in first])
        return cls(rows, torch.stack(place).view(inputs.shape[:-1]))

    @property
    def steps(self) -> Tensor:
        """Inputs at each step, ``[P, B, T, I]``."""
        return each_step(self.rows, self.place)

    def beside(self, other: StepInputs) -> StepInputs:
        """Append other rounds of the same people, both padded to equal lengths."""
        steps = max(self.place.shape[-1], other.place.shape[-1])
        own = pad(self.place, [0, steps - self.place.shape[-1]])
        more = pad(other.place, [0, steps - other.place.shape[-1]]) + self.rows.shape[1]
        return StepInputs(torch.cat([self.rows, other.rows], 1), torch.cat([own, more], 1))


def each_step(rows: Tensor, place: Tensor) -> Tensor:
    """Look up each step's row ``[P, B, T, I]`` in ``[P, N, I]``, by ``place`` ``[P, B, T]``."""
    begin = rows.shape[1] * torch.arange(len(rows), device=place.device)[:, None, None]
    return rows.flatten(0, 1)[place + begin]


def _distinct(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Distinct rows of ``[N, I]``, and for each row the index of its distinct one ``[N]``."""
    first, place = distinct_rows(as_whole_numbers(rows))
    return rows[first], place

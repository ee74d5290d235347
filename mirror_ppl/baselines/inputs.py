"""What recurrent baselines read at each step of rounds.

Items of all modalities as the domain's symbols, with masks: which are visible, which were told. Of
most steps the same is to be read as of others, so each different row of inputs is kept once.

Networks of the sight "informed" are given what a message means, as the human model is: what is told
counts as seen and no more, and what follows from everything seen and told so far can be read as
well (:meth:`mirror_ppl.domains.base.Domain.known`).
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
"""Which items a network reads: those that the setting shows or that were told, or all visual ones,
or those that the setting shows or that follow from what was seen and told.
"""
INFORMED: Sight = "informed"
"""The sight to which what is told is as if it were seen."""
SIGHTS: tuple[Sight, ...] = get_args(Sight)


def network_inputs(
    domain: Domain,
    observation: Observation,
    seen: Visibility,
    told: Visibility,
    previous: Tensor,
) -> Tensor:
    """What a recurrent network reads at each step, ``[..., I]``; zero for all that is not visible.

    Args:
        domain: the world.
        observation: everything that there was to observe, ego ``[..., E]`` and modalities
            ``[..., K, F]`` in the domain's units.
        seen: what the setting shows, ``[..., K]`` for each modality.
        told: what is communicated, likewise.
        previous: indices ``[...]`` of the actions before, A where there was none.
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
    """Which items a setting lets a baseline read, ``[..., K]`` for each modality."""
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
    """What a baseline reads at one step as seen and as told, and the knowledge after it.

    Args:
        domain: the world.
        sight: which items are read.
        setting: which lets people see what they see by themselves.
        knowledge: the domain's, of the step before; only read and changed if informed.
        observation: everything that there is to observe, ``[..., K, F]``.
        told: what is communicated ``[..., K]``.
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
    """What a baseline reads at each step of recorded rounds, ``[P, B, T, I]``."""
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
    # Padding has the action -1, which is nobody's business but has to have a symbol.
    previous = torch.cat([none, actions[:, :, :-1].clamp(min=0)], 2)
    return network_inputs(domain, observation, seen, heard, previous)


def input_size(domain: Domain) -> int:
    """I, the number of inputs that `network_inputs` makes."""
    items = sum(len(m.items) * (domain.symbol_sizes[m.name] + 2) for m in domain.modalities)
    return domain.symbol_sizes["ego"] + items + len(domain.actions) + 1


@dataclass(frozen=True)
class StepInputs:
    """What P people's networks read at each step of B rounds, different rows kept once.

    Attributes:
        rows: the N different ones of each person, padded with zeros ``[P, N, I]``.
        place: which of them each step's is, ``[P, B, T]``.
    """

    rows: Tensor
    place: Tensor

    @classmethod
    def of(cls, inputs: Tensor) -> StepInputs:
        """Of what is read at each step, ``[P, B, T, I]``."""
        first, place = zip(*(_distinct(own) for own in inputs.flatten(1, 2)), strict=True)
        most = max(len(rows) for rows in first)
        rows = torch.stack([pad(rows, [0, 0, 0, most - len(rows)]) for rows in first])
        return cls(rows, torch.stack(place).view(inputs.shape[:-1]))

    @property
    def steps(self) -> Tensor:
        """What is read at each step, ``[P, B, T, I]``."""
        return each_step(self.rows, self.place)

    def beside(self, other: StepInputs) -> StepInputs:
        """These rounds and then those of another, of the same people, padded to equal lengths."""
        steps = max(self.place.shape[-1], other.place.shape[-1])
        own = pad(self.place, [0, steps - self.place.shape[-1]])
        more = pad(other.place, [0, steps - other.place.shape[-1]]) + self.rows.shape[1]
        return StepInputs(torch.cat([self.rows, other.rows], 1), torch.cat([own, more], 1))


def each_step(rows: Tensor, place: Tensor) -> Tensor:
    """Of rows ``[P, N, I]`` that of each step ``[P, B, T, I]``, by ``place`` ``[P, B, T]``."""
    begin = rows.shape[1] * torch.arange(len(rows), device=place.device)[:, None, None]
    return rows.flatten(0, 1)[place + begin]


def _distinct(rows: Tensor) -> tuple[Tensor, Tensor]:
    """The different ones of rows ``[N, I]``, and which of them each is ``[N]``."""
    first, place = distinct_rows(as_whole_numbers(rows))
    return rows[first], place

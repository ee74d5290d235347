"""Results of rounds that a person played with a communicator: rewards, messages, relevance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mirror_ppl.communication.messages import Channels
from mirror_ppl.domains.base import Domain, Observation, total_reward


@dataclass(frozen=True)
class Played:
    """R rounds of one person with one communicator.

    Attributes:
        task: reward of the task, ``[R]``.
        cost: of the messages, ``[R]``.
        mishaps: number of steps with the domain's mishap, ``[R]``.
        items: number of communicated items by modality, ``[R]`` each.
        relevant: number of relevant ones, by notion of relevance and modality, ``[R]``.
        communicable: number of communicable items, by modality, summed over rounds.
        steps: number of decisions: steps of all rounds before their ends.
        milliseconds: mean time of a decision.
        log: one entry per decision, if requested.
        hears: final probability that messages of each modality reach the person; empty for
            communicators that do not infer it.
    """

    task: list[float]
    cost: list[float]
    mishaps: list[int]
    items: dict[str, list[int]]
    relevant: dict[str, dict[str, list[int]]]
    communicable: dict[str, int]
    steps: int
    milliseconds: float
    log: list[dict[str, Any]] = field(default_factory=list)
    hears: dict[str, float] = field(default_factory=dict)

    @classmethod
    def joined(cls, parts: Sequence[Played]) -> Played:
        """Join rounds that were played one after the other."""
        first, steps = parts[0], sum(one.steps for one in parts)

        def listed(name: str) -> list:
            return [value for one in parts for value in getattr(one, name)]

        return cls(
            listed("task"),
            listed("cost"),
            listed("mishaps"),
            {name: [n for one in parts for n in one.items[name]] for name in first.items},
            {
                notion: {
                    name: [n for one in parts for n in one.relevant[notion][name]] for name in own
                }
                for notion, own in first.relevant.items()
            },
            {name: sum(one.communicable[name] for one in parts) for name in first.communicable},
            steps,
            sum(one.milliseconds * one.steps for one in parts) / max(steps, 1),
            [entry | {"round": place} for place, one in enumerate(parts) for entry in one.log],
        )

    @property
    def net(self) -> np.ndarray:
        """Task reward less cost, ``[R]``."""
        return np.asarray(self.task) - np.asarray(self.cost)

    def rates(self) -> dict[str, float]:
        """Share of the communicable items that were communicated, by modality."""
        return {
            name: sum(items) / max(self.communicable[name], 1) for name, items in self.items.items()
        }


class Tally:
    """Accumulates the results of R rounds, see `Played`."""

    def __init__(self, domain: Domain, channels: Channels, rounds: int) -> None:
        self.domain, self.channels = domain, channels
        self.task, self.cost = torch.zeros(rounds), torch.zeros(rounds)
        self.mishaps = torch.zeros(rounds, dtype=torch.long)
        self.items = {m.name: torch.zeros_like(self.mishaps) for m in self.domain.modalities}
        self.relevant: dict[str, dict[str, Tensor]] = {}
        self.communicable = dict.fromkeys(self.items, 0)
        self.steps = 0

    def add_messages(self, observation: Observation, flags: Tensor, under_way: Tensor) -> None:
        """Count messages ``[R, N]`` and communicable items of a step."""
        self.steps += int(under_way.sum())
        self.cost += self.channels.cost(flags)
        may = self._by_modality(self.channels.join(self.domain.communicable(observation)))
        messages = self._by_modality(flags)
        for name, mask in messages.items():
            self.items[name] += mask.sum(-1)
            self.communicable[name] += int(may[name][under_way].sum())
        for notion, masks in self.domain.relevance(observation).items():
            counts = self.relevant.setdefault(
                notion, {name: torch.zeros_like(count) for name, count in self.items.items()}
            )
            relevant = self._by_modality(self.channels.join(masks))
            for name, mask in messages.items():
                counts[name] += (mask & relevant[name]).sum(-1)

    def _by_modality(self, flags: Tensor) -> dict[str, Tensor]:
        """Split flags ``[R, N]``; a group counts as one item."""
        return dict(zip(self.items, flags.split(self.channels.sizes, -1), strict=True))

    def add_rewards(self, terms: Mapping[str, Tensor]) -> None:
        """Add rewards ``[R]`` of a step, by term."""
        self.task += total_reward(terms)
        self.mishaps += (terms[self.domain.mishap[0]] < 0).long()

    def played(self, seconds: float, log: list[dict[str, Any]]) -> Played:
        """Return the results of the rounds, whose decisions took ``seconds`` in all."""
        return Played(
            self.task.tolist(),
            self.cost.tolist(),
            self.mishaps.tolist(),
            _lists(self.items),
            {notion: _lists(counts) for notion, counts in self.relevant.items()},
            self.communicable,
            self.steps,
            1000 * seconds / max(self.steps, 1),
            log,
        )


def _lists(counts: Mapping[str, Tensor]) -> dict[str, list[int]]:
    return {name: count.tolist() for name, count in counts.items()}

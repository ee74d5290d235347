"""Default memory of people: items as they were last seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.domains.modality import Modality


@dataclass(frozen=True)
class LastSeen:
    """Last seen features of each item, modalities concatenated.

    Attributes:
        seen: whether an item was seen or communicated in the round so far, boolean ``[..., K]``.
        known: whether it is unchanged since then, boolean ``[..., K]``.
        content: its features then, ``[..., K F]``; 0 for items never seen.
    """

    seen: Tensor
    known: Tensor
    content: Tensor

    @classmethod
    def nothing(
        cls, modalities: Sequence[Modality], *batch: int, device: torch.device | None = None
    ) -> LastSeen:
        """Return the memory ``[*batch]`` before anything was seen."""
        items = sum(len(m.items) for m in modalities)
        values = sum(len(m.items) * len(m.features) for m in modalities)
        never = torch.zeros(*batch, items, dtype=torch.bool, device=device)
        return cls(never, never, torch.zeros(*batch, values, device=device))

    def after(
        self,
        modalities: Sequence[Modality],
        lasting: Sequence[str],
        observation: Observation,
        visible: Visibility,
    ) -> LastSeen:
        """Return the memory after a step at which some items ``[..., K]`` were perceived.

        Args:
            modalities: of the world.
            lasting: names of items that stay known once seen, even if they change.
            observation: full observation ``[..., K, F]``.
            visible: items that were seen or communicated.
        """
        now = torch.cat([observation[m.name].flatten(-2) for m in modalities], -1)
        new = torch.cat([visible[m.name] for m in modalities], -1)
        sizes = [len(m.features) for m in modalities for _ in m.items]
        repeats = torch.tensor(sizes, device=new.device)
        content = torch.where(new.repeat_interleave(repeats, -1), now, self.content)
        parts = (content == now).split(sizes, -1)
        as_seen = torch.stack([part.all(-1) for part in parts], -1)
        stays = torch.tensor(
            [item in lasting for m in modalities for item in m.items], device=new.device
        )
        seen = self.seen | new
        return LastSeen(seen, seen & (as_seen | stays), content)

    def items(self, modalities: Sequence[Modality]) -> Visibility:
        """Return known items ``[..., K]`` by modality."""
        parts = self.known.split([len(m.items) for m in modalities], -1)
        return {m.name: part for m, part in zip(modalities, parts, strict=True)}

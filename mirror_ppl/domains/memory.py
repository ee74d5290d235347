"""What people keep in mind of items in worlds that have no memory of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.domains.base import Modality, Observation, Visibility


@dataclass(frozen=True)
class LastSeen:
    """What was last seen of each item of all modalities, one behind the other.

    Attributes:
        seen: whether an item was seen or told of in the round so far, boolean ``[..., K]``.
        known: whether it still is as it was then, boolean ``[..., K]``.
        content: its features as they were then, ``[..., K F]``; 0 of what was never seen.
    """

    seen: Tensor
    known: Tensor
    content: Tensor

    @classmethod
    def nothing(
        cls, modalities: Sequence[Modality], *batch: int, device: torch.device | None = None
    ) -> LastSeen:
        """Before anything was seen, ``[*batch]``."""
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
        """After a step at which some items ``[..., K]`` were seen or told of.

        Args:
            modalities: of the world.
            lasting: names of items that stay known once they were seen, however they change.
            observation: everything there is to observe ``[..., K, F]``.
            visible: what was seen or told.
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
        """Known items ``[..., K]`` by modality."""
        parts = self.known.split([len(m.items) for m in modalities], -1)
        return {m.name: part for m, part in zip(modalities, parts, strict=True)}

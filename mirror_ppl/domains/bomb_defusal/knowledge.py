"""A person's knowledge of a bomb.

The type of the bomb does not change and stays known. Every stage has its own terminals: those seen
are known until the next stage.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.domains.bomb_defusal.panel import TERMINALS


@dataclass(frozen=True)
class BombKnowledge:
    """Knowledge at one step.

    Attributes:
        stage: of that step ``[..., 1]``.
        terminals: terminals with known symbols ``[..., 6]``.
        kind: whether the type of the bomb is known ``[..., 1]``.
    """

    stage: Tensor
    terminals: Tensor
    kind: Tensor

    @classmethod
    def nothing(cls, *batch: int, device: torch.device | None = None) -> BombKnowledge:
        """Return the knowledge before anything was observed."""
        return cls(
            torch.zeros(*batch, 1, dtype=torch.long, device=device),
            torch.zeros(*batch, TERMINALS, dtype=torch.bool, device=device),
            torch.zeros(*batch, 1, dtype=torch.bool, device=device),
        )

    def learn(self, observation: Observation, visible: Visibility) -> BombKnowledge:
        """Return the knowledge one step later; see `mirror_ppl.domains.base.Domain.learn`."""
        stage = observation["ego"][..., :1].round().long()
        kind = self.kind | visible["verbal"]
        terminals = (self.terminals & (stage == self.stage)) | visible["visual"]
        return BombKnowledge(stage.expand(kind.shape), terminals, kind)

    def items(self) -> Visibility:
        """Return terminals ``[..., 6]`` and utterances ``[..., 1]`` whose content is known."""
        return {"visual": self.terminals, "verbal": self.kind}

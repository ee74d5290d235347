"""Distinct views of one round."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from mirror_ppl.domains import Observation
from mirror_ppl.likelihood.belief_nodes import beliefs_and_values
from mirror_ppl.likelihood.chain import Chain
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.view import View
from mirror_ppl.row_hashing import distinct_rows


@dataclass(frozen=True)
class RoundViews:
    """V distinct views of one round, and the moments that they share; see :class:`ViewTable`.

    Attributes:
        moments: ``[V, T]``.
        belief: ``[N, Z]``.
        values: ``[N, A]``.
        acted: ``[N]``.
        sights: the view under each value of attention, ``[U, G]``; ``None`` if a sight is a view.
        rounds: of each sight ``[U]``, if there is more than one round.
        chain: attention that is summed out exactly, of one person; views are of its spans.
    """

    moments: Tensor
    belief: Tensor
    values: Tensor
    acted: Tensor
    sights: Tensor | None = None
    rounds: Tensor | None = None
    chain: Chain | None = None

    def __len__(self) -> int:
        """The number of sights U."""
        if self.chain is not None:
            return self.chain.sights
        return len(self.moments if self.sights is None else self.sights)

    def lengthened(self, steps: int) -> RoundViews:
        """The same with padding at the end, as part of a table of longer rounds."""
        more = steps - self.moments.shape[1]
        if not more:
            return self
        return replace(self, moments=pad(self.moments, [0, more], value=NO_VIEW))

    def kept(self, sights: Tensor) -> RoundViews:
        """Only some sights, and the views and moments that they have."""
        if self.chain is not None:
            chain, views = self.chain.kept(sights)
            return replace(replace(self, chain=None).kept(views), chain=chain)
        if self.sights is not None:
            views, place = torch.unique(self.sights[sights], return_inverse=True)
            rounds = None if self.rounds is None else self.rounds[sights]
            alone = replace(self, sights=None, rounds=None)
            return replace(alone.kept(views), sights=place, rounds=rounds)
        moments = self.moments[sights]
        real = moments != NO_VIEW
        used, place = torch.unique(moments[real], return_inverse=True)
        moments = moments.clone()
        moments[real] = place
        if not len(used):  # of padding alone; act() is asked about something all the same
            used = used.new_zeros(1)
        return RoundViews(moments, self.belief[used], self.values[used], self.acted[used])


def round_views(
    human: HumanModel,
    view: View,
    observation: Observation,
    actions: Tensor,
    real: Tensor,
    combinations: int,
) -> tuple[RoundViews, Tensor]:
    """Distinct views of one round, and which of them each combination has."""
    view = view.map(lambda part: part.expand(combinations, *part.shape[1:]))
    numbers = view.numbers() * real
    first, inverse = distinct_rows(numbers)
    some = view.map(lambda part: part[first])
    belief, values, node = beliefs_and_values(human, some, numbers[first], observation, actions)
    acted = actions.expand(node.shape)
    at = acted.new_zeros(len(belief)).scatter(0, node.flatten(), acted.flatten())
    moments = torch.where(real, node, NO_VIEW)
    return RoundViews(moments, belief, values, at), inverse

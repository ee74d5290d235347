"""Combinations of discrete implants that have seen the same in every round, taken together.

Nothing recorded tells them apart, so their likelihood is one and their posterior is their prior.
After few rounds there are far fewer sets of them than combinations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mirror_ppl.distinct import distinct_rows
from mirror_ppl.models.view_table import NO_VIEW, ViewTable


@dataclass(frozen=True)
class Alike:
    """G sets of C combinations of one person.

    Attributes:
        first: one combination of each set, ``[G]``.
        log_prior: of each set, ``[G]``; 0 where priors of combinations differ from draw to draw of
            the other implants, in which case every combination is a set of its own.
        fixed: whether priors do not.
        members: the combinations, set after set, ``[C]``.
        share: prior probability of all members up to each, ``[C]``.
        end: how many members there are up to each set, ``[G]``.
    """

    first: Tensor
    log_prior: Tensor
    fixed: bool
    members: Tensor
    share: Tensor
    end: Tensor

    @classmethod
    def of(cls, table: ViewTable, log_priors: Tensor) -> Alike:
        """Of the possible combinations of a table of one person.

        Args:
            table: views of the person's rounds.
            log_priors: log prior probabilities under draws of the other implants, ``[S, M]``.
        """
        possible = (table.index[0] != NO_VIEW).all(0) | ~table.real.any()
        combinations = possible.nonzero().squeeze(-1)
        own = log_priors[:, combinations]
        fixed = bool((own == own[:1]).all())
        if not fixed:
            number = torch.arange(1, len(combinations) + 1, device=combinations.device)
            none = own.new_zeros(len(combinations))
            return cls(combinations, none, False, combinations, number.double(), number)
        first, which = distinct_rows(table.index[0][:, combinations].T)
        # In the order of combinations, however views are numbered.
        first, place = first.sort()
        which = place.argsort()[which]
        prior = own[0].double().exp()
        order = which.argsort(stable=True)
        total = prior.new_zeros(len(first)).index_add(0, which, prior)
        return cls(
            combinations[first],
            total.log().to(own),
            True,
            combinations[order],
            prior[order].cumsum(0),
            torch.bincount(which, minlength=len(first)).cumsum(0),
        )

    def __len__(self) -> int:
        return len(self.first)

    def kept(self, sets: Tensor) -> Alike:
        """Only some sets ``[G]``, as truth values."""
        some = sets.repeat_interleave(self.sizes)
        chance = self.share.diff(prepend=self.share.new_zeros(1))
        return replace(
            self,
            first=self.first[sets],
            log_prior=self.log_prior[sets],
            members=self.members[some],
            share=chance[some].cumsum(0),
            end=self.sizes[sets].cumsum(0),
        )

    @property
    def sizes(self) -> Tensor:
        """Members of each set ``[G]``."""
        return self.end.diff(prepend=self.end.new_zeros(1))

    def draw(self, sets: Tensor) -> Tensor:
        """One combination of each of these sets ``[n]``, by its prior; from the global state."""
        upper = self.share[self.end - 1]
        lower = upper.roll(1).index_fill(0, self.end.new_zeros(1), 0)
        place = lower[sets] + (upper - lower)[sets] * torch.rand_like(upper[sets])
        chosen = torch.searchsorted(self.share, place)
        begin = (self.end - self.sizes)[sets]
        # Rounding may lead over the border.
        return self.members[torch.minimum(torch.maximum(chosen, begin), self.end[sets] - 1)]

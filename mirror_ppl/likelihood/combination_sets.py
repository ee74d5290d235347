"""Sets of combinations of what perception reads that have the same view of every round.

The recordings do not distinguish them: they have the same likelihood, so within a set the posterior
is proportional to the prior. After few rounds there are far fewer sets than combinations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mirror_ppl.likelihood.combinations import log_priors
from mirror_ppl.likelihood.view_table import NO_VIEW, ViewTable
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.row_hashing import distinct_rows

TRIED = 8
"""Draws of other implants under which priors of combinations are compared."""
COMPARED = 256
"""Combinations in that comparison, a random subset."""


@torch.no_grad()
def fixed_prior(human: HumanModel, grid: Mapping[str, Tensor]) -> Tensor | None:
    """Log prior ``[M]`` of combinations; ``None`` if it depends on the other implants.

    Args:
        human: the model of people.
        grid: values ``[M, ...]`` of the sites that perception reads.
    """
    found = dependencies(human)
    for name, parents in found.prior.items():
        if name in grid or parents & grid.keys():
            # Scales and masks of a sampled site may depend on its own value.
            own = {name} & found.latent
            if (parents | own) - grid.keys():
                return None
    others = draw_prior(human, 1, TRIED, 0)
    policy = {name: value for name, value in others.items() if name not in grid}
    number = len(next(iter(grid.values()), (0,)))
    order = torch.randperm(number, generator=torch.Generator().manual_seed(0))
    some = order[:COMPARED].to(next(human.parameters()).device)
    few = {name: value[some] for name, value in grid.items()}
    tried = log_priors(human, few, policy, 1)[:, 0]
    # Tracking of dependencies misses in-place assignment to parts of a tensor.
    if bool((tried != tried[:1]).any()):
        return None
    return log_priors(human, grid, {}, 1)[0, 0]


@dataclass(frozen=True)
class EquivalentCombinations:
    """G sets of C combinations of one person.

    Attributes:
        first: one combination of each set, ``[G]``.
        log_prior: log prior of each set, ``[G]``; 0 if priors of combinations depend on the other
            implants, in which case every combination is a set of its own.
        fixed: True if priors do not depend on the other implants.
        members: the combinations, set after set, ``[C]``.
        share: cumulative prior probability of the members, ``[C]``.
        end: cumulative number of members of the sets, ``[G]``.
    """

    first: Tensor
    log_prior: Tensor
    fixed: bool
    members: Tensor
    share: Tensor
    end: Tensor

    @classmethod
    def of(cls, table: ViewTable, log_prior: Tensor | None) -> EquivalentCombinations:
        """Group the possible combinations of a table of one person.

        Args:
            table: views of the person's rounds.
            log_prior: see :func:`fixed_prior`, ``[M]``.
        """
        possible = (table.index[0] != NO_VIEW).all(0) | ~table.real.any()
        combinations = possible.nonzero().squeeze(-1)
        if log_prior is None:
            number = torch.arange(1, len(combinations) + 1, device=combinations.device)
            none = table.values.new_zeros(len(combinations))
            return cls(combinations, none, False, combinations, number.double(), number)
        own = log_prior[combinations]
        first, which = distinct_rows(table.index[0][:, combinations].T)
        # In the order of combinations, independent of how views are numbered.
        first, place = first.sort()
        which = place.argsort()[which]
        # Relative to the largest, since many observations may make all of them tiny.
        largest = own.max()
        prior = (own.double() - largest).exp()
        order = which.argsort(stable=True)
        total = prior.new_zeros(len(first)).index_add(0, which, prior)
        return cls(
            combinations[first],
            total.log().to(own) + largest,
            True,
            combinations[order],
            prior[order].cumsum(0),
            torch.bincount(which, minlength=len(first)).cumsum(0),
        )

    def __len__(self) -> int:
        return len(self.first)

    def kept(self, sets: Tensor) -> EquivalentCombinations:
        """Select sets by a mask ``[G]``."""
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
        """Number of members of each set ``[G]``."""
        return self.end.diff(prepend=self.end.new_zeros(1))

    def draw(self, sets: Tensor) -> Tensor:
        """Draw a combination of each of these sets ``[n]`` by its prior (global random state)."""
        upper = self.share[self.end - 1]
        lower = upper.roll(1).index_fill(0, self.end.new_zeros(1), 0)
        place = lower[sets] + (upper - lower)[sets] * torch.rand_like(upper[sets])
        chosen = torch.searchsorted(self.share, place)
        begin = (self.end - self.sizes)[sets]
        # Rounding may lead into a neighbouring set.
        return self.members[torch.minimum(torch.maximum(chosen, begin), self.end[sets] - 1)]

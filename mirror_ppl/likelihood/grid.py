"""Joint values of the sites that perception reads, over which engines sum.

They are all combinations of the values of discrete sites, or, if one of the sites is continuous,
weighted points (:mod:`mirror_ppl.likelihood.points`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor

from mirror_ppl.errors import HumanModelError
from mirror_ppl.row_hashing import as_whole_numbers, mixed, row_numbers


@dataclass(frozen=True, eq=False)
class Grid(Mapping[str, Tensor]):
    """M joint values of sites of the prior, as a mapping from sites to values ``[M, ...]``.

    A sum over all values is a sum over these, of which points are divided by their density::

        sum_m p(m) f(m)  or  E[f(m)]  =  sum_m exp(log_prior_m - log_proposal_m) f(m)

    Attributes:
        by_site: the values, ``[M, ...]``.
        sizes: number of values of each site if these are all combinations, row-major; None for
            points.
        log_proposal: of points, the logarithm of their number times the density with which they
            were drawn ``[M]``; None for 0.
        read: names of the sites that perception reads; all unless given. Points also have the sites
            on which these depend.
    """

    by_site: dict[str, Tensor]
    sizes: tuple[int, ...] | None = None
    log_proposal: Tensor | None = None
    read: tuple[str, ...] | None = None

    def __getitem__(self, site: str) -> Tensor:
        return self.by_site[site]

    def __iter__(self) -> Iterator[str]:
        return iter(self.by_site)

    def __len__(self) -> int:
        return len(self.by_site)

    @property
    def is_points(self) -> bool:
        """True for points, False for all combinations."""
        return self.sizes is None

    @property
    def number(self) -> int:
        """The number of joint values M."""
        return (
            prod(self.sizes) if self.sizes is not None else len(next(iter(self.by_site.values())))
        )

    def chosen(self, some: Tensor) -> Grid:
        """Select joint values by number ``[n]``, as points."""
        proposal = self.log_proposal
        return Grid(
            {site: value[some] for site, value in self.by_site.items()},
            log_proposal=None if proposal is None else proposal[some],
            read=self.read,
        )

    def place_of(self, implants: Mapping[str, Tensor]) -> Tensor:
        """Number of the joint value ``[...]`` of implants ``[..., *]``, event dimensions behind.

        Raises:
            HumanModelError: implants are none of the points.
        """
        if self.sizes is not None:
            return combination_number(implants, dict(zip(self.by_site, self.sizes, strict=True)))
        sites = self.by_site if self.read is None else self.read
        dims = {site: self.by_site[site].dim() - 1 for site in sites}
        own = _hashed({site: self.by_site[site] for site in sites}, dims)
        wanted = _hashed({site: implants[site] for site in sites}, dims)
        ordered, order = own.sort()
        place = torch.searchsorted(ordered, wanted).clamp(max=len(ordered) - 1)
        if not bool((ordered[place] == wanted).all()):
            raise HumanModelError(
                f"values of {', '.join(sites)} are none of the points with which rounds were "
                "compiled"
            )
        return order[place]


def _hashed(values: Mapping[str, Tensor], dims: Mapping[str, int]) -> Tensor:
    """Whole numbers ``[...]`` that differ between joint values ``[..., *]``."""
    each = []
    for site, value in values.items():
        whole = as_whole_numbers(value.detach())
        whole = whole.flatten(-dims[site]) if dims[site] else whole[..., None]
        each.append(row_numbers(whole))
    return mixed(*torch.broadcast_tensors(*each))


def combination_number(implants: Mapping[str, Tensor], sizes: Mapping[str, int]) -> Tensor:
    """Number of the combination of implants ``[...]``, row-major over these sites."""
    number = torch.zeros((), dtype=torch.long)
    for site, size in sizes.items():
        value = implants[site].long()
        number = number.to(value.device) * size + value
    return number


def grid_of(supports: Mapping[str, Tensor]) -> Grid:
    """All M combinations of values of sites, row-major, given their supports ``[n]``."""
    # A grid of indices, since supports may have different dtypes.
    places = [torch.arange(len(support), device=support.device) for support in supports.values()]
    axes = torch.meshgrid(*places, indexing="ij") if places else ()
    return Grid(
        {
            site: support[axis.flatten()]
            for (site, support), axis in zip(supports.items(), axes, strict=True)
        },
        tuple(len(support) for support in supports.values()),
    )

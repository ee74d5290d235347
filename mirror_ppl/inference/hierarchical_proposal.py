"""Proposals for sites whose prior depends on others, such as probabilities with a common mean.

In unconstrained space such sites form a funnel: their spread depends on their parents, which no
Gaussian represents. Standardized by their conditional prior given the parents, ::

    u = (x - m) / s        m, s  mean and standard deviation of the prior, in unconstrained space

they are much closer to Gaussian (the non-centred parametrization: Papaspiliopoulos, Roberts and
Skold, *A general framework for the parametrization of hierarchical models*, 2007).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from pyro.distributions import TorchDistribution
from pyro.poutine.messenger import Messenger
from torch import Tensor

from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import sample_sites
from mirror_ppl.randomness import forked


def dependent_sites(human: HumanModel, sites: Mapping[str, Any]) -> tuple[str, ...]:
    """Scalar sites whose prior depends on other scalar sites, and on nothing else.

    Sites that also depend on sites of other kinds are excluded, because those are not proposed
    together with the scalar ones. So are sites without moments.
    """
    parents = dependencies(human).prior
    with forked():
        nodes = sample_sites(human, 1)
    return tuple(
        name
        for name, site in sites.items()
        if parents[name] and parents[name] <= sites.keys() and _has_moments(nodes[name]["fn"], site)
    )


def _has_moments(fn: Any, site: Any) -> bool:
    """True if a prior has a mean and a standard deviation in unconstrained space."""
    try:
        middle, scale = _moments(fn, site)
    except NotImplementedError:
        return False
    return bool(middle.isfinite().all() and scale.isfinite().all() and (scale > 0).all())


class RelativeProposal:
    """A density over scalar sites, in which dependent sites are standardized by their prior.

    Args:
        human: the model of people.
        sites: the D scalar sites, with the map from unconstrained space.
        dependent: those that depend on others.
        place: draws in unconstrained space ``[S, D]``.
        fit: fits a density to draws ``[S, D]``, with dependent sites standardized.
    """

    def __init__(
        self,
        human: HumanModel,
        sites: Mapping[str, Any],
        dependent: tuple[str, ...],
        place: Tensor,
        fit: Callable[[Tensor], TorchDistribution],
    ) -> None:
        self.human, self.sites, self.dependent = human, sites, dependent
        relative, _ = self._relative(place)
        self.density = fit(relative)

    def sample(self, sample_shape: torch.Size) -> Tensor:
        """Draws ``[S, D]`` in unconstrained space."""
        (number,) = sample_shape
        relative = self.density.sample(sample_shape)
        placed = _Placed(self, relative)
        with forked():
            sample_sites(self.human, 1, number, handler=placed)
        return torch.stack([placed.place[name] for name in self.sites], -1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density ``[S]`` in unconstrained space."""
        relative, log_scale = self._relative(value)
        return self.density.log_prob(relative) - log_scale

    @torch.no_grad()
    def _relative(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Standardize dependent sites of ``[S, D]``; also returns the log of the scale ``[S]``."""
        number, columns = len(place), place.unbind(-1)
        given = {
            name: site(column).view(number, 1, 1)
            for (name, site), column in zip(self.sites.items(), columns, strict=True)
        }
        with forked():
            nodes = sample_sites(self.human, 1, number, given)
        relative, log_scale = [], place.new_zeros(number)
        for (name, site), column in zip(self.sites.items(), columns, strict=True):
            if name in self.dependent:
                middle, scale = (part.view(-1) for part in _moments(nodes[name]["fn"], site))
                column = (column - middle) / scale
                log_scale = log_scale + scale.log()
            relative.append(column)
        return torch.stack(relative, -1), log_scale


class _Placed(Messenger):
    """Effect handler that sets scalar sites while the program runs, parents first.

    Attributes:
        place: value of each site in unconstrained space ``[S]``.
    """

    def __init__(self, proposal: RelativeProposal, relative: Tensor) -> None:
        super().__init__()
        self.proposal = proposal
        self.place: dict[str, Tensor] = {}
        self._relative = dict(zip(proposal.sites, relative.unbind(-1), strict=True))

    def _pyro_sample(self, msg: Any) -> None:
        name, sites = msg["name"], self.proposal.sites
        if name not in sites or name in self.place:
            return
        place = self._relative[name]
        if name in self.proposal.dependent:
            middle, scale = (part.view(-1) for part in _moments(msg["fn"], sites[name]))
            place = middle + scale * place
        self.place[name] = place
        msg["value"] = sites[name](place).view(-1, 1, 1)
        msg["done"] = True


def _moments(fn: Any, site: Any) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of a prior in unconstrained space, to first order."""
    middle = site.inv(fn.mean)
    slope = site.log_abs_det_jacobian(middle, fn.mean)
    return middle, fn.stddev * (-slope).exp()

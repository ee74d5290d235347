"""A mixture of Gaussians with reparameterized draws, as the ELBO needs them.

The choice of a component has no gradient, but a draw ``z`` is also the point where the conditional
distribution functions ``u_d = F(z_d | z_1 .. z_d-1)`` have given values. If parameters change at
constant ``u``, ``z`` moves by ``-(du/dz)^-1 du`` (Figurnov, Mohamed and Mnih, *Implicit
reparameterization gradients*, 2018).
"""

from __future__ import annotations

from typing import cast

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.special import ndtr


class GaussianMixture(dist.MixtureSameFamily):
    """A mixture of K Gaussians in D dimensions.

    Args:
        mixture_distribution: ``Categorical`` over the components, ``[..., K]``.
        component_distribution: ``MultivariateNormal`` with a ``scale_tril``, ``[..., K, D]``.
    """

    has_rsample = True

    def rsample(self, sample_shape: torch.Size = torch.Size()) -> Tensor:  # noqa: B008 - as torch
        """Draws ``[*sample_shape, ..., D]``, with gradients."""
        drawn = self.sample(sample_shape)
        if not torch.is_grad_enabled():
            return drawn
        drawn.requires_grad_()
        levels = self._levels(drawn)
        slopes = [
            torch.autograd.grad(level.sum(), drawn, retain_graph=True)[0]
            for level in levels.unbind(-1)
        ]
        change = (levels - levels.detach())[..., None]
        moved = torch.linalg.solve_triangular(torch.stack(slopes, -2), change, upper=False)
        return drawn.detach() - moved.squeeze(-1)

    def _levels(self, value: Tensor) -> Tensor:
        """Conditional distribution functions ``[..., D]``, each given the dimensions before it."""
        components = cast(dist.MultivariateNormal, self.component_distribution)
        scale = components.scale_tril
        centred = (value[..., None, :] - components.loc)[..., None]
        standard = torch.linalg.solve_triangular(scale, centred, upper=False).squeeze(-1)
        scale = scale.diagonal(dim1=-2, dim2=-1)
        density = -standard.square() / 2 - scale.log()
        so_far = density.cumsum(-1) - density  # of the dimensions before
        shares = torch.softmax(self.mixture_distribution.logits[..., None] + so_far, -2)
        return (shares * ndtr(standard)).sum(-2)

"""The network of the amortized guide: ``q(psi | rounds)`` as a Pyro program.

It reads the log-evidence of rounds under each way, see :mod:`mirror_ppl.inference.amortized`.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor, nn

from mirror_ppl.errors import InputError
from mirror_ppl.inference.margins import (
    PriorDependence,
    PriorMargins,
    independent,
    prior_dependence,
    prior_knots,
)
from mirror_ppl.inference.mixture import GaussianMixture
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, draw_prior, scalar_sites, unconstrained

WAYS = 64
COMPONENTS = 4
HIDDEN = 128
DROPOUT = 0.2
TEMPERATURES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
PRIOR_DRAWS = 20_000
LEAST_EVIDENCE = -30.0
SOFTPLUS_ONE = 0.5413  # its softplus is 1


def guide_screening() -> Screening:
    """Screening settings of an amortized guide, whose policies are the ways."""
    return Screening(policies=WAYS)


class AmortizedGuide(nn.Module):
    """``q(psi | rounds)`` of the scalar sites of a human model, in unconstrained space.

    Before training it approximates the prior.

    Args:
        places: the ways in unconstrained space, ``[W, D]``.
        prior: prior draws in unconstrained space, for the margins, ``[S, D]``; by default the ways.
        dependent: True if sites of the prior depend on each other.
        dropout: dropout rate in training.

    Attributes:
        knots: knots of the prior's margins, see :class:`PriorMargins`, ``[D, K]``.
        mean, log_scale: coefficients of :class:`PriorDependence`, ``[D, F]``.
        ways: the ways in the space where the prior is standard normal, ``[W, D]``.
        gate: weight in the mean, at each temperature of the evidence, of the importance sampling
            estimate from the prior, ``[temperatures, D]``.
    """

    ways: Tensor
    knots: Tensor
    mean: Tensor
    log_scale: Tensor

    def __init__(
        self,
        places: Tensor,
        prior: Tensor | None = None,
        dependent: bool = False,
        dropout: float = DROPOUT,
    ) -> None:
        super().__init__()
        number, self.dimensions = places.shape
        prior = places if prior is None else prior
        self.register_buffer("knots", prior_knots(prior))
        mean, log_scale = independent(self.dimensions)
        if dependent:
            mean, log_scale = prior_dependence(torch.as_tensor(PriorMargins(self.knots).inv(prior)))
        self.register_buffer("mean", mean)
        self.register_buffer("log_scale", log_scale)
        self.register_buffer("ways", self.prior.inv(places))
        moments = 2 * self.dimensions + 1
        triangle = self.dimensions * (self.dimensions + 1) // 2
        self.body = nn.Sequential(
            nn.Linear(number + len(TEMPERATURES) * moments + 1, HIDDEN),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(HIDDEN, HIDDEN),
            nn.ReLU(),
            nn.Dropout(dropout),
        )
        self.head = nn.Linear(HIDDEN, COMPONENTS * (1 + self.dimensions + triangle))
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.normal_(self.head.bias, std=0.1)
        self.gate = nn.Parameter(torch.zeros(len(TEMPERATURES), self.dimensions))

    @property
    def prior(self) -> dist.transforms.Transform:
        """Transform from standard normal to unconstrained space, ``[..., D]``."""
        dependence = PriorDependence(self.mean, self.log_scale)
        return dist.transforms.ComposeTransform([dependence, PriorMargins(self.knots)])

    def features(self, log_evidence: Tensor, steps: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the network's input ``[..., F]`` from log-evidence ``[..., W]`` and step counts.

        They are the log-evidence, and importance sampling estimates of means and standard
        deviations with the ways as prior draws, at several temperatures. Also returns these means,
        ``[..., temperatures, D]``.
        """
        relative = log_evidence - log_evidence.amax(-1, keepdim=True)
        parts, means = [relative.clamp(min=LEAST_EVIDENCE) / 10.0], []
        for temperature in TEMPERATURES:
            weights = torch.softmax(relative / temperature, -1)
            mean = weights @ self.ways
            spread = (weights @ self.ways.square() - mean.square()).clamp(min=0).sqrt()
            effective = 1 / weights.square().sum(-1, keepdim=True)
            parts += [mean, spread, effective / len(self.ways)]
            means.append(mean)
        parts.append(torch.log1p(steps.to(relative))[..., None] / 5.0)
        return torch.cat(parts, -1), torch.stack(means, -2)

    def reads(self, places: Tensor) -> bool:
        """True if the network was trained for ways at these points ``[W, D]``."""
        if self.ways.shape != places.shape:
            return False
        own = torch.as_tensor(self.prior(self.ways)).cpu()
        return torch.allclose(own, places.to(own), atol=1e-3)

    def mixture_parameters(self, log_evidence: Tensor, steps: Tensor) -> Tensor:
        """Parameters ``[..., COMPONENTS, M]`` of ``q`` given this evidence."""
        features, means = self.features(log_evidence, steps)
        out = self.head(self.body(features)).unflatten(-1, (COMPONENTS, -1))
        towards = (self.gate * means).sum(-2)[..., None, :]
        return out + nn.functional.pad(towards, [1, out.shape[-1] - 1 - self.dimensions])

    def density(self, log_evidence: Tensor, steps: Tensor) -> dist.TorchDistribution:
        """Density ``q`` in unconstrained space, ``[..., D]``."""
        return self.mixture(self.mixture_parameters(log_evidence, steps))

    def mixture(self, parameters: Tensor) -> dist.TorchDistribution:
        """Density in unconstrained space from parameters ``[..., COMPONENTS, M]``."""
        size = self.dimensions
        logits, mean, triangle = parameters.split([1, size, size * (size + 1) // 2], -1)
        rows, columns = torch.tril_indices(size, size)
        lower = mean.new_zeros(*triangle.shape[:-1], size, size)
        lower[..., rows, columns] = triangle
        # 1 before training, as the prior's.
        diagonal = nn.functional.softplus(lower.diagonal(dim1=-2, dim2=-1) + SOFTPLUS_ONE) + 1e-3
        lower = torch.tril(lower, -1) + torch.diag_embed(diagonal)
        mixture = GaussianMixture(
            dist.Categorical(logits=logits.squeeze(-1)),
            dist.MultivariateNormal(mean, scale_tril=lower),
        )
        return dist.TransformedDistribution(mixture, [self.prior])

    def forward(
        self, sites: Mapping[str, dist.transforms.Transform], log_evidence: Tensor, steps: Tensor
    ) -> None:
        """The guide as a Pyro program over the scalar sites of P people, ``[P, W]`` and ``[P]``."""
        person = pyro.plate("person", len(log_evidence), dim=-2)
        sample_scalars(sites, self.density(log_evidence[:, None], steps[:, None]), person)


def sample_scalars(
    sites: Mapping[str, dist.transforms.Transform],
    density: dist.TorchDistribution,
    person: pyro.plate,
) -> Draws:
    """Pyro program that samples the scalar sites of P people from a density ``[P, 1]``.

    Returns:
        The values ``[P, 1]`` by site.
    """
    values = {}
    with person:
        place = pyro.sample("place", density, infer={"is_auxiliary": True})
        for column, (name, site) in enumerate(sites.items()):
            value = site(place[..., column])
            stretch = site.log_abs_det_jacobian(place[..., column], value)
            values[name] = pyro.sample(name, dist.Delta(value, log_density=-stretch))
    return values


def reference_places(human: HumanModel, number: int = WAYS) -> Tensor:
    """Ways from the prior in unconstrained space, ``[W, D]``; fixed for a human model.

    They are drawn on the CPU, since a GPU has other random numbers.
    """
    if next(human.parameters()).device.type != "cpu":
        human = copy.deepcopy(human).to("cpu")
    return unconstrained(scalar_sites(human), draw_prior(human, 1, number, Screening.seed))


def require_network_of(human: HumanModel, network: AmortizedGuide) -> None:
    """Refuse networks that were trained for another human model.

    Raises:
        InputError: the network is for another human model.
    """
    if not network.reads(reference_places(human)):
        raise InputError(
            f"the network is for another human model than {type(human).__name__} in "
            f"{human.domain.name}; see load_guide"
        )

"""Refinement of a network's proposal on recorded rounds by ``pyro.infer.SVI``.

The network covers the scalar sites. The other continuous sites (the weights of a residual) have a
mean-field guide. Discrete sites are summed out of the ELBO.
"""

from __future__ import annotations

from collections.abc import Callable

import pyro
import pyro.distributions as dist
import torch

from mirror_ppl.inference.amortized_guide import AmortizedGuide, sample_scalars
from mirror_ppl.inference.svi import SVIOptions, continuous_guide, optimize, own_parameters
from mirror_ppl.likelihood.compiled import Compiled, ViewTables
from mirror_ppl.models.prior import Draws, sample_sites, scalar_sites

REFINING_RATE = 0.02
"""Learning rate of Adam, which starts near the optimum."""


def with_mean_field(
    compiled: Compiled, density: Callable[[], dist.TorchDistribution]
) -> Callable[[], Draws]:
    """Make a guide of P people: a Pyro program that samples all continuous sites ``[P, 1, ...]``.

    Args:
        compiled: the human program and the rounds.
        density: makes the density ``[P, 1]`` of the scalar sites in unconstrained space.
    """
    sites = scalar_sites(compiled.human)
    others = sample_sites(compiled.human, 1).keys() - sites.keys() - compiled.discrete
    rest = continuous_guide(compiled, without=tuple(sites)) if others else None

    def guide() -> Draws:
        person = pyro.plate("person", compiled.people, dim=-2)
        values = sample_scalars(sites, density(), person)
        if rest is not None:
            rest.create_plates = lambda: person
            values |= rest()
        return values

    return guide


def refined(
    network: AmortizedGuide,
    compiled: ViewTables,
    log_evidence: torch.Tensor,
    recorded: int,
    steps: int,
) -> dist.TorchDistribution:
    """Refine the network's density for one person by gradient steps.

    It stays in the network's mixture family; its parameters start at the network's output.

    Args:
        network: the trained network.
        compiled: the human program and the person's rounds.
        log_evidence: the network's input, ``[W]``.
        recorded: number of recorded actions.
        steps: gradient steps.
    """
    number = torch.tensor(recorded, device=log_evidence.device)
    with torch.no_grad():
        start = network.mixture_parameters(log_evidence, number)[None, None]
    with own_parameters(int(torch.randint(2**31, ()))), torch.enable_grad():
        guide = with_mean_field(
            compiled, lambda: network.mixture(pyro.param("mixture", start.clone()))
        )
        optimize(compiled, guide, SVIOptions(steps=steps, learning_rate=REFINING_RATE))
        found = pyro.param("mixture").detach()
    return network.mixture(found[0, 0])

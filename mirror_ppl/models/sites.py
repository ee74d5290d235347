"""Reading the sample sites of a run of a Pyro program."""

from __future__ import annotations

from typing import Any

from pyro.poutine import Trace
from pyro.poutine.util import site_is_subsample
from torch import Tensor


def latent_sites(trace: Trace) -> dict[str, Any]:
    """Nodes of the sites that were sampled: not observed or conditioned, and no plates."""
    return {
        name: site
        for name, site in trace.nodes.items()
        if site["type"] == "sample" and not site["is_observed"] and not site_is_subsample(site)
    }


def latent_values(trace: Trace) -> dict[str, Tensor]:
    """Values of the sites that were sampled."""
    return {name: site["value"] for name, site in latent_sites(trace).items()}


def discrete_names(trace: Trace) -> set[str]:
    """Names of the sampled sites that can be enumerated."""
    return {name for name, site in latent_sites(trace).items() if site["fn"].has_enumerate_support}

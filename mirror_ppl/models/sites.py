"""Reads the sample sites of a trace of a Pyro program."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from pyro.poutine import Trace
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from mirror_ppl.errors import HumanModelError


def latent_sites(trace: Trace) -> dict[str, Any]:
    """Return the nodes that were sampled: neither observed, nor conditioned, nor plates."""
    return {
        name: site
        for name, site in trace.nodes.items()
        if site["type"] == "sample" and not site["is_observed"] and not site_is_subsample(site)
    }


def sample_nodes(trace: Trace) -> dict[str, Any]:
    """Return the nodes that are sampled, observed or factors; no plates."""
    return {
        name: node
        for name, node in trace.nodes.items()
        if node["type"] == "sample" and not site_is_subsample(node)
    }


def latent_values(trace: Trace) -> dict[str, Tensor]:
    """Return the values of the sites that were sampled."""
    return {name: site["value"] for name, site in latent_sites(trace).items()}


def discrete_names(trace: Trace) -> set[str]:
    """Return the names of the sampled sites that can be enumerated."""
    return {name for name, site in latent_sites(trace).items() if site["fn"].has_enumerate_support}


class Readable(Mapping[str, Tensor]):
    """Implants for ``perceive``: records which are read and refuses those that are not sampled.

    Args:
        known: values of sites by name.
        others: names of all other values that ``prior`` returned.
        copied: names of the sites that are read by who goes through all implants, as to copy them;
            all that are known unless given.
    """

    def __init__(
        self,
        known: Mapping[str, Tensor],
        others: Collection[str] = (),
        copied: Collection[str] | None = None,
    ) -> None:
        self.known = known
        self.others = others
        self.copied = known if copied is None else copied
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Tensor:
        if name not in self.known:
            raise HumanModelError(
                f'perceive() reads "{name}", which is no site that prior() or round_latents() '
                f"returns; it can read: {', '.join(self.known) or 'none'}"
            )
        self.read.add(name)
        return self.known[name]

    def __contains__(self, name: object) -> bool:
        if name in self.known or name in self.others:  # a membership test depends on the site
            return self[str(name)] is not None
        return False

    def __iter__(self) -> Iterator[str]:
        return iter(self.copied)

    def __len__(self) -> int:
        return len(self.copied)


class OnlyRead(dict[str, Tensor]):
    """Implants for ``perceive``: refuses sites that were found not to be read.

    Args:
        known: values by name.
        others: names of the sites that are not read.
    """

    def __init__(self, known: Mapping[str, Tensor], others: Collection[str]) -> None:
        super().__init__(known)
        self.others = others

    def __missing__(self, name: str) -> Tensor:
        raise HumanModelError(
            f'perceive() reads "{name}" in some rounds only, and did not where it was tried; let '
            "it read the same sites at every step, whatever it does with their values"
        )

    def __contains__(self, name: object) -> bool:
        if name in self.others:
            self.__missing__(str(name))
        return super().__contains__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """Return the value of a site, or a default; see `dict.get`."""
        return super().get(name, default) if name in self else default

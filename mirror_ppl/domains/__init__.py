"""Worlds as pure batched functions, and their Gymnasium faces."""

from mirror_ppl.domains.base import Domain, Modality, Observation, Visibility, require_known
from mirror_ppl.domains.bomb_defusal import BombDefusal
from mirror_ppl.domains.driving import Driving
from mirror_ppl.domains.search_rescue import SearchRescue

DOMAINS: dict[str, Domain] = {
    domain.name: domain for domain in (Driving(), SearchRescue(), BombDefusal())
}
"""Every domain by name."""


def get_domain(name: str) -> Domain:
    """Return the domain of that name.

    Raises:
        UnknownNameError: if there is none, listing the known ones.
    """
    return DOMAINS[require_known(name, "domain", tuple(DOMAINS))]


__all__ = ["DOMAINS", "Domain", "Modality", "Observation", "Visibility", "get_domain"]

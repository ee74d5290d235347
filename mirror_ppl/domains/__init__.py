"""Worlds as pure batched functions, and their Gymnasium environments."""

from mirror_ppl.domains.base import Domain, Observation, Visibility, require_known
from mirror_ppl.domains.controls import Control
from mirror_ppl.domains.modality import Modality
from mirror_ppl.domains.record import Record
from mirror_ppl.domains.registry import DOMAINS, add_domain, added_worlds, domain_of, get_domain
from mirror_ppl.domains.world import World, offers

__all__ = [
    "DOMAINS",
    "Control",
    "Domain",
    "Modality",
    "Observation",
    "Visibility",
    "Record",
    "World",
    "add_domain",
    "added_worlds",
    "domain_of",
    "get_domain",
    "offers",
    "require_known",
]

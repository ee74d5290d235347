"""Communicators without a model of the person: what a planner has to be better than."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains.base import Domain


def nothing(domain: Domain, past: RoundSoFar) -> Tensor:
    """Silence, flags ``[N]``."""
    return torch.zeros(len(Channels(domain)), dtype=torch.bool)


def everything(domain: Domain, past: RoundSoFar) -> Tensor:
    """Everything that may be communicated, at every step, flags ``[N]``."""
    return Channels(domain).join(domain.communicable(past.now))


def nearest(domain: Domain, past: RoundSoFar, setting: str) -> Tensor:
    """A sensible rule by hand, flags ``[N]``: the nearest thing that the setting hides.

    One thing a step, and each only once; nothing that is farther away than half the range of
    sight. It is said where it can be said, which tells more, and else shown.
    """
    channels = Channels(domain)
    flags = torch.zeros(len(channels), dtype=torch.bool)
    now = past.now
    _, distance = domain.distance(now)
    hidden = ~domain.visibility(setting, now)["visual"]
    for mask in past.told.values():
        hidden &= ~mask.any(0)
    allowed = domain.communicable(now)
    may = torch.stack(list(allowed.values())).any(0)
    candidates = hidden & may & (distance <= domain.reach_bins[-1] / 2)
    if candidates.any():
        item = int(torch.where(candidates, distance, torch.inf).argmin())
        name = "verbal" if allowed["verbal"][item] else "visual"
        masks = channels.split(flags)
        masks[name][item] = True  # a view into the flags
    return flags


def at_random(
    domain: Domain, past: RoundSoFar, rates: Mapping[str, float], generator: torch.Generator
) -> Tensor:
    """Each item that may be communicated with the probability of its modality, flags ``[N]``."""
    channels = Channels(domain)
    chance = torch.cat([torch.full((len(m.items),), rates[m.name]) for m in domain.modalities])
    drawn = torch.rand(len(channels), generator=generator) < chance
    return drawn & channels.join(domain.communicable(past.now))

"""Baseline communicators without a model of the person."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains.base import Domain


def nothing(domain: Domain, past: RoundSoFar) -> Tensor:
    """Return silence, flags ``[N]``."""
    return torch.zeros(len(Channels(domain)), dtype=torch.bool)


def everything(domain: Domain, past: RoundSoFar) -> Tensor:
    """Return everything that may be communicated, at every step, flags ``[N]``."""
    return Channels(domain).join(domain.communicable(past.now))


def nearest(domain: Domain, past: RoundSoFar, setting: str) -> Tensor:
    """Return the nearest item that the setting hides, flags ``[N]``: a hand-written rule.

    One item a step, each only once; no item farther away than half the range of sight, and none
    that all people know. It is said if it has a more informative utterance that is allowed, else
    shown.
    """
    channels = Channels(domain)
    flags = torch.zeros(len(channels), dtype=torch.bool)
    now = past.now
    _, distance = domain.distance(now)
    allowed = domain.communicable(now)
    known = domain.known(domain.nothing_known(device=distance.device))["visual"]
    hidden = ~domain.visibility(setting, now)["visual"] & ~known
    may_say = torch.zeros_like(hidden)
    told = past.told["visual"].any(0)
    for item, spoken in enumerate(domain.counterparts):
        if spoken is not None:
            may_say[item] = allowed["verbal"][spoken]
            told[item] |= past.told["verbal"][:, spoken].any()
    may = (allowed["visual"] | may_say) & ~told
    candidates = hidden & may & (distance <= domain.reach_bins[-1] / 2)
    if candidates.any():
        item = int(torch.where(candidates, distance, torch.inf).argmin())
        spoken = domain.counterparts[item]
        if spoken is not None and may_say[item]:
            flags[channels.flag_of("verbal", spoken)] = True
        else:
            flags[channels.flag_of("visual", item)] = True
    return flags


def at_random(
    domain: Domain, past: RoundSoFar, rates: Mapping[str, float], generator: torch.Generator
) -> Tensor:
    """Draw each allowed item with the probability of its modality, flags ``[N]``."""
    channels = Channels(domain)
    chance = torch.cat(
        [torch.full((len(m.communicated),), rates[m.name]) for m in domain.modalities]
    )
    drawn = torch.rand(len(channels), generator=generator) < chance
    return drawn & channels.join(domain.communicable(past.now))

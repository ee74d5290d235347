"""Speech: what can be said about the nearest car in each of six directions.

=====  ====================  =======================================================
0      approaching fast      the distance shrinks by ``FAST`` or more
1      approaching slowly    it shrinks
2      moving away fast      it grows by ``FAST`` or more
3      moving away slowly    it grows, or stays
4      braking               the car slows down by ``BRAKING`` or more, whatever its distance
5      nothing there         no car in that direction within the range of the lidar
=====  ====================  =======================================================

A direction is a lane, the ego's own or the one beside it, ahead or behind; a car abreast is ahead.
The paper names the messages of its experiment, but not where one ends and the next begins.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mirror_ppl.domains.highway.lidar import RANGE
from mirror_ppl.domains.highway.state import HighwayState

DIRECTIONS = ("front", "front-right", "rear-right", "rear", "rear-left", "front-left")
"""Clockwise, as the sectors of the lidar."""
SIDES = (0, 1, 1, 0, -1, -1)
"""Lanes to the right of the ego's."""
AHEAD = (True, True, False, False, False, True)

WORDS = (
    "approaching fast",
    "approaching slowly",
    "moving away fast",
    "moving away slowly",
    "braking",
)
PLACES = (
    "ahead",
    "ahead on the right",
    "behind on the right",
    "behind",
    "behind on the left",
    "ahead on the left",
)
UTTERANCES = tuple(
    (*(f"Car {place}, {words}." for words in WORDS), f"Nothing {place}.") for place in PLACES
)
"""Six sentences for each direction."""
NOTHING = len(WORDS)

FAST = 3.0
"""m/s, about 11 km/h."""
BRAKING = 2.0
"""m/s2: harder than letting off the accelerator, softer than an emergency stop."""


def utterances(state: HighwayState) -> Tensor:
    """Return the index ``[..., 6]`` of the true sentence about each direction."""
    offset = state.x[..., 1:] - state.x[..., :1]
    aside = state.lane[..., 1:] - state.lane[..., :1]
    side = torch.tensor(SIDES, device=offset.device)
    ahead = torch.tensor(AHEAD, device=offset.device)
    there = (aside[..., None, :] == side[:, None]) & ((offset >= 0)[..., None, :] == ahead[:, None])
    distance = torch.where(there, offset.abs()[..., None, :], math.inf)
    least, nearest = distance.min(-1)
    speed = state.speed * torch.cos(state.heading)
    faster = (speed[..., 1:] - speed[..., :1]).gather(-1, nearest)
    growing = torch.where(ahead, faster, -faster)
    fast = growing.abs() >= FAST
    said = torch.where(growing < 0, torch.where(fast, 0, 1), torch.where(fast, 2, 3))
    brakes = state.acceleration[..., 1:].gather(-1, nearest) <= -BRAKING
    said = torch.where(brakes, WORDS.index("braking"), said)
    return torch.where(least <= RANGE, said, NOTHING)

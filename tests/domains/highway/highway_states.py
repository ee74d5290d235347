"""States of the highway that tests lay out by hand."""

from dataclasses import replace

import torch

from mirror_ppl.domains.highway.road import LIMIT, OTHERS, lane_of
from mirror_ppl.domains.highway.state import NEVER, HighwayState

FAR = 500.0
"""Metres ahead at which cars stand that a test does not mention."""


def state_of(ego=(0.0, 4.0, 0.0, 10.0), cars=(), dtype=torch.float64, **fields):
    """A round without batch: the ego and cars as (x, y, heading, speed), and other fields."""
    away = [(FAR + 50.0 * k, 4.0, 0.0, 10.0) for k in range(OTHERS - len(cars))]
    rows = torch.tensor([ego, *cars, *away], dtype=dtype)
    x, y, heading, speed = rows.unbind(-1)
    zeros, whole = torch.zeros_like(x), torch.zeros(len(x), dtype=torch.long)
    made = HighwayState(
        x=x,
        y=y,
        heading=heading,
        speed=speed,
        acceleration=zeros,
        target_lane=lane_of(y),
        cruise=torch.cat([torch.tensor([LIMIT], dtype=dtype), speed[1:]]),
        headway=zeros + 1.5,
        changes=whole > 0,
        timer=whole,
        cue_at=whole + NEVER,
        cue_gap=zeros,
        cue_lane=lane_of(y),
        cue_speed=zeros,
        cue_for=whole,
        begun=whole + NEVER,
        controls=zeros[:2],
        tick=torch.tensor(0),
        crashed=torch.tensor(False),
    )
    return replace(made, **fields)

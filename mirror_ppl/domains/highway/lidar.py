"""Lidar: the nearest vehicle in each of 36 sectors around the ego, its distance and its motion.

Sector ``k`` is 10 degrees wide; its middle is ``10 k`` degrees clockwise from the ego's heading, so
that sector 0 faces ahead and sector 18 back. Its distance is that of the nearest point of any
vehicle within the sector, measured from the ego's centre, where the sensor is.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mirror_ppl.domains.highway.geometry import clearance, corners, seen_from
from mirror_ppl.domains.highway.road import LENGTH
from mirror_ppl.domains.highway.state import HighwayState

SECTORS = 36
SECTOR = 2 * math.pi / SECTORS
"""Width of a sector in radians."""
AHEAD, BACK = 0, SECTORS // 2
"""Sectors that face ahead and back."""
RANGE = 60.0
"""Metres beyond which the lidar sees nothing; distance of a sector in which there is nothing."""
RESOLUTION = 1 / 32
"""Metres, and m/s, to which measurements are rounded; recordings are smaller for it."""
FEATURES = ("distance", "velocity_along", "velocity_across")
UNITS = ("m", "m/s", "m/s")


def scan(state: HighwayState) -> Tensor:
    """Return what the lidar measures.

    Args:
        state: ``[...]``.

    Returns:
        ``[..., 36, 3]``: distance in metres, and the velocity of the nearest vehicle relative to
        the ego in m/s, along the ego's heading and across it to the right. An empty sector has
        distance ``RANGE`` and no velocity. All are rounded to ``RESOLUTION``.
    """
    boxes = seen_boxes(state)
    middles = torch.arange(SECTORS, dtype=boxes.dtype, device=boxes.device) * SECTOR
    distance, nearest = nearest_in(boxes, middles)
    speed, turned = state.speed[..., 1:], boxes[..., 2]
    along = speed * torch.cos(turned) - state.speed[..., :1]
    across = speed * torch.sin(turned)
    hit = distance < RANGE
    motion = [torch.where(hit, each.gather(-1, nearest), 0.0) for each in (along, across)]
    measured = torch.stack([torch.where(hit, distance, RANGE), *motion], -1)
    return (measured / RESOLUTION).round() * RESOLUTION


def seen_boxes(state: HighwayState) -> Tensor:
    """Return the other vehicles as boxes ``[..., K, 3]`` in the frame of the ego."""
    boxes = torch.stack([state.x, state.y, state.heading], -1)
    return seen_from(boxes[..., 1:, :], boxes[..., 0, :])


def nearest_in(boxes: Tensor, middles: Tensor) -> tuple[Tensor, Tensor]:
    """Return the nearest box of each sector.

    Args:
        boxes: ``[..., K, 3]`` in the frame of the sensor.
        middles: directions of sectors in radians ``[D]``.

    Returns:
        Distances in metres ``[..., D]`` of the nearest point within each sector, at least
        ``RANGE`` and possibly infinite if there is none in range, and indices ``[..., D]`` of the
        boxes that these points belong to.
    """
    # Most cars of an estimated state are absent, which means far away.
    near = torch.hypot(boxes[..., 0], boxes[..., 1]) < RANGE + LENGTH
    distance = boxes.new_full((*near.shape, len(middles)), math.inf)
    distance[near] = distances(boxes[near], middles)
    least, index = distance.min(-2)
    return least, index


def distances(boxes: Tensor, middles: Tensor) -> Tensor:
    """Return the distance ``[..., K, D]`` of each box within each sector, infinite outside it.

    Each side of a box is cut to a sector; what is left of it has a nearest point. A sensor inside
    a box is at distance 0 of it in every sector.
    """
    corner = corners(boxes)
    x, y = (part[..., None] for part in corner.unbind(-1))
    dx, dy = (part[..., None] for part in (corner.roll(-1, -2) - corner).unbind(-1))
    least = torch.zeros((), dtype=boxes.dtype, device=boxes.device)
    most, outside = least + 1, least > 0
    for side in (-1, 1):
        bound = middles + side * SECTOR / 2
        across, along = side * torch.sin(bound), -side * torch.cos(bound)
        # Metres within this bound of the sector, at the start of a side and gained along it.
        within, gain = x * across + y * along, dx * across + dy * along
        crossing = -within / torch.where(gain == 0, 1.0, gain)
        least = torch.where(gain > 0, torch.maximum(least, crossing), least)
        most = torch.where(gain < 0, torch.minimum(most, crossing), most)
        outside = outside | ((gain == 0) & (within < 0))
    foot = -(x * dx + y * dy) / (dx * dx + dy * dy)
    place = torch.maximum(torch.minimum(foot, most), least)
    length = torch.hypot(x + place * dx, y + place * dy)
    nearest = torch.where(outside | (least > most), math.inf, length).amin(-2)
    return torch.where((clearance(boxes) == 0)[..., None], 0.0, nearest)

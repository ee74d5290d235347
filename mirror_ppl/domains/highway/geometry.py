"""Rectangles seen from above: their corners, overlap, and how near they come to the origin.

A box is ``(x, y, heading)`` of its centre, in metres and radians; all have a vehicle's size.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mirror_ppl.domains.highway.road import LENGTH, WIDTH


def corners(box: Tensor) -> Tensor:
    """Return the corners ``[..., 4, 2]`` of boxes ``[..., 3]``, one after the other around it."""
    x, y, heading = box.unbind(-1)
    forward = torch.stack([torch.cos(heading), torch.sin(heading)], -1)[..., None, :]
    aside = torch.stack([-torch.sin(heading), torch.cos(heading)], -1)[..., None, :]
    half = box.new_tensor([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
    centre = torch.stack([x, y], -1)[..., None, :]
    return centre + half[:, :1] * LENGTH * forward + half[:, 1:] * WIDTH * aside


def overlap(one: Tensor, other: Tensor) -> Tensor:
    """Return whether boxes ``[..., 3]`` overlap or touch ``[...]``.

    Two rectangles are apart if they are apart along a side of one of them.
    """
    way = other - one
    cos, sin = torch.cos(way[..., 2]).abs(), torch.sin(way[..., 2]).abs()
    along = (LENGTH + LENGTH * cos + WIDTH * sin) / 2
    across = (WIDTH + LENGTH * sin + WIDTH * cos) / 2
    touching = torch.ones_like(along, dtype=torch.bool)
    for heading in (one[..., 2], other[..., 2]):
        forward, aside = torch.cos(heading), torch.sin(heading)
        touching = touching & ((way[..., 0] * forward + way[..., 1] * aside).abs() <= along)
        touching = touching & ((way[..., 1] * forward - way[..., 0] * aside).abs() <= across)
    return touching


def seen_from(box: Tensor, viewer: Tensor) -> Tensor:
    """Return boxes ``[..., K, 3]`` in the frame of a viewer ``[..., 3]`` that looks along x."""
    origin = viewer[..., None, :]
    cos, sin = torch.cos(origin[..., 2]), torch.sin(origin[..., 2])
    dx, dy = box[..., 0] - origin[..., 0], box[..., 1] - origin[..., 1]
    return torch.stack([cos * dx + sin * dy, cos * dy - sin * dx, box[..., 2] - origin[..., 2]], -1)


def clearance(box: Tensor) -> Tensor:
    """Return metres ``[...]`` from the origin to the nearest point of boxes ``[..., 3]``."""
    local = seen_from(torch.zeros_like(box)[..., None, :], box)[..., 0, :2].abs()
    half = box.new_tensor([LENGTH / 2, WIDTH / 2])
    return (local - half).clamp(min=0).norm(dim=-1)

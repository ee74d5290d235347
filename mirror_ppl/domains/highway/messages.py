"""What people can be shown and told: groups of sectors, and sentences about six directions.

People see sectors; a message shows them a whole group of neighbouring sectors, so that there are
six visual and six verbal items, in the same order. The coefficients of costs are those of
driving in Table I of the supplement, which has no row for CARLA: showing *n* groups at a decision
costs ``0.01 n^2`` units of reward, saying *n* sentences ``0.03 n^2``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mirror_ppl.domains.base import Modality
from mirror_ppl.domains.highway.lidar import FEATURES, RANGE, SECTORS, UNITS
from mirror_ppl.domains.highway.speech import DIRECTIONS, NOTHING, UTTERANCES

SCALES = (RANGE, 10.0, 10.0)
"""Typical sizes of the features of a sector, in their units."""
SHOWING, SAYING = 0.01, 0.03
"""Coefficients of costs, in units of reward."""

SEEN = Modality(
    "visual",
    tuple(f"{10 * k} degrees" for k in range(SECTORS)),
    FEATURES,
    UNITS,
    SCALES,
    SHOWING,
)
"""What is seen: one item a sector, clockwise from the ego's heading. Messages show groups."""
SHOWN = Modality("visual", DIRECTIONS, FEATURES, UNITS, SCALES, SHOWING)
"""What can be shown: one item a group of sectors; its features are those of each sector."""
SPOKEN = Modality(
    "verbal", DIRECTIONS, ("utterance",), ("index",), (float(NOTHING),), SAYING,
    utterances=UTTERANCES,
)  # fmt: skip
"""What can be said: one item a direction."""

GROUPS = (
    (34, 35, 0, 1, 2),
    (3, 4, 5, 6, 7, 8),
    (9, 10, 11, 12, 13, 14, 15),
    (16, 17, 18, 19, 20),
    (21, 22, 23, 24, 25, 26, 27),
    (28, 29, 30, 31, 32, 33),
)
"""Sectors of each group: within 25 degrees ahead and behind, and the sides, parted where they are
5 degrees ahead of abreast, so that a car beside the ego, which drivers do not see, is behind."""


def sectors_of(groups: Tensor) -> Tensor:
    """Return the sectors ``[..., 36]`` that are shown with groups ``[..., 6]``, both boolean."""
    owner = torch.empty(SECTORS, dtype=torch.long, device=groups.device)
    for group, sectors in enumerate(GROUPS):
        owner[list(sectors)] = group
    return groups[..., owner]


def cost(shown: Tensor, said: Tensor) -> Tensor:
    """Return the cost ``[...]`` in units of reward of a message.

    Args:
        shown: groups ``[..., 6]`` that are shown.
        said: directions ``[..., 6]`` that are spoken of.
    """
    return SHOWN.cost(shown.sum(-1)) + SPOKEN.cost(said.sum(-1))

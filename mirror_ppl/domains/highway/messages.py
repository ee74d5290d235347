"""What can be communicated to people: groups of sectors, and sentences about six directions.

People see sectors; a message shows them a whole group of neighbouring sectors, so that there are
six groups and six sentences, in the same order. The coefficients of costs are those of driving in
Table I of the supplement, which has no row for CARLA: showing *n* groups at a decision costs
``0.01 n^2`` units of reward, saying *n* sentences ``0.03 n^2``.
"""

from __future__ import annotations

from mirror_ppl.domains.highway.lidar import FEATURES, RANGE, SECTORS, UNITS
from mirror_ppl.domains.highway.speech import DIRECTIONS, NOTHING, UTTERANCES
from mirror_ppl.domains.modality import Modality

SCALES = (RANGE, 10.0, 10.0)
"""Typical sizes of the features of a sector, in their units."""
SHOWING, SAYING = 0.01, 0.03
"""Coefficients of costs, in units of reward."""

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

SEEN = Modality(
    "visual",
    tuple(f"{10 * k} degrees" for k in range(SECTORS)),
    FEATURES,
    UNITS,
    SCALES,
    SHOWING,
    groups=tuple(zip(DIRECTIONS, GROUPS, strict=True)),
)
"""What is seen: one item a sector, clockwise from the ego's heading. Messages show groups."""
SPOKEN = Modality(
    "verbal", DIRECTIONS, ("utterance",), ("index",), (float(NOTHING),), SAYING,
    utterances=UTTERANCES,
)  # fmt: skip
"""What can be said: one item a direction."""


def group_of(sector: int) -> int:
    """Return the index of the group that a sector belongs to, which is that of its direction."""
    return next(group for group, sectors in enumerate(GROUPS) if sector in sectors)

"""Checks of a world's attributes: names, numbers and lists that have to fit each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

from mirror_ppl.domains.derived import VISUAL
from mirror_ppl.domains.world import World, offers

VERBAL = "verbal"
"""The modality that ``counterparts`` are items of."""


def faults_of_attributes(world: World) -> list[str]:
    """Return the faults of a world's attributes, each with what was expected and what was found."""
    found = []
    if len(world.actions) < 2:  # noqa: PLR2004 - one action is no choice
        found.append(f"actions: expected at least 2, found {len(world.actions)}")
    if not world.ego_features:
        found.append("ego_features: expected at least one, found none")
    if not (isinstance(world.horizon, int) and world.horizon > 0):
        found.append(f"horizon: expected a whole number above 0, found {world.horizon!r}")
    if list(world.reach_bins) != sorted(set(world.reach_bins)):
        found.append(f"reach_bins: expected growing numbers, found {world.reach_bins}")
    for name in ("actions", "settings", "reward_terms"):
        names = getattr(world, name)
        if isinstance(names, str) or len(set(names)) < len(names) or not names:
            found.append(f"{name}: expected a tuple of different names, found {names!r}")
    known = {*world.ego_features, *(name for m in world.modalities for name in m.features)}
    for name, levels in world.levels.items():
        if name not in known:
            found.append(f"levels: {name} is no feature; there are {', '.join(sorted(known))}")
        elif not isinstance(levels, range) or not levels:
            found.append(f"levels: {name} has to have a range that is not empty, found {levels!r}")
    if len(world.directions) > 1 and not offers(world, "distance"):
        found.append(
            f"distance: there are {len(world.directions)} directions, of which the default gives "
            "the first to all items; define it"
        )
    if world.mishap[0] not in world.reward_terms:
        found.append(f"mishap: expected one of reward_terms, found {world.mishap[0]!r}")
    items = [item for modality in world.modalities for item in modality.items]
    if isinstance(world.lasting, str):
        found.append(f"lasting: expected a tuple of items, found {world.lasting!r}")
    for name in world.lasting if not isinstance(world.lasting, str) else ():
        if name not in items:
            found.append(f"lasting: {name!r} is no item; there are {', '.join(items)}")
    return found + _of_practice(world) + _of_counterparts(world)


def _of_practice(world: World) -> list[str]:
    """Check the numbers by which views are drawn in training."""
    found = []
    weights, bins = world.reach_practice, world.reach_bins
    if len(weights) and not (
        len(weights) == len(bins) and all(_in_range(w, None) for w in weights) and sum(weights) > 0
    ):
        found.append(
            f"reach_practice: expected a weight for each of the {len(bins)} reach_bins, at least 0 "
            f"and not all 0, found {weights}"
        )
    if not _in_range(world.told_practice, 1):
        found.append(
            f"told_practice: expected a probability, 0 to 1, found {world.told_practice!r}"
        )
    return found


def _of_counterparts(world: World) -> list[str]:
    """Check that counterparts have, for each visual item, None or the index of a verbal one."""
    items = {m.name: len(m.items) for m in world.modalities}
    spoken, found = items.get(VERBAL, 0), world.counterparts
    fitting = isinstance(found, Sequence) and len(found) == items[VISUAL]
    if fitting and all(each is None or each in range(spoken) for each in found):
        return []
    return [
        f"counterparts: expected one for each of {items[VISUAL]} visual items, None or the index "
        f"of one of {spoken} {VERBAL} items, found {found!r}"
    ]


def _in_range(value: Any, most: float | None) -> bool:
    """True for a finite number from 0 up to another one, if there is one."""
    if not isinstance(value, Real) or not 0 <= float(value) < math.inf:
        return False
    return most is None or float(value) <= most

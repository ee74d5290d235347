"""Attributes of worlds that are derived from others unless given."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

from mirror_ppl.domains.base import require_known
from mirror_ppl.domains.controls import action_names
from mirror_ppl.errors import DomainError

if TYPE_CHECKING:
    from mirror_ppl.domains.world import World

MOST_ACTIONS = 127
"""Largest number of actions on the grid of controls; files store actions in one byte."""
VISUAL = "visual"


def complete(kind: type[World]) -> frozenset[str]:
    """Set the attributes of a class of worlds that are derived from others; return their names.

    Raises:
        DomainError: a required attribute is missing, or they do not match.
    """
    if not isinstance(kind.controls, tuple):
        raise DomainError(f"{kind.__name__}: controls have to be a tuple of Control")
    names = [one.name for one in kind.controls]
    if len(set(names)) < len(names):
        raise DomainError(f"{kind.__name__}: controls need different names, found {names}")
    if math.prod(one.levels for one in kind.controls) > MOST_ACTIONS:
        raise DomainError(
            f"{kind.__name__}: controls have more than {MOST_ACTIONS} combinations of levels"
        )
    if kind.controls and kind.given("actions"):
        raise DomainError(f"{kind.__name__}: actions are derived from controls; give one of them")
    for name in ("modalities", "ego_features", "actions", "horizon"):
        if not (hasattr(kind, name) or (name == "actions" and kind.controls)):
            raise DomainError(f"{kind.__name__} needs {name}; see docs/adding_a_world.md")
    visual = [m for m in kind.modalities if m.name == VISUAL]
    if len(visual) != 1:
        found = ", ".join(m.name for m in kind.modalities) or "none"
        raise DomainError(f'{kind.__name__}: one modality has to be "{VISUAL}", found {found}')
    features = visual[0].features
    for name in kind.positions:
        require_known(name, "position", features, kind.__name__)
    sizes = [visual[0].scales[features.index(name)] for name in kind.positions]
    units = {visual[0].units[features.index(name)] for name in kind.positions}
    bins = tuple(float(number) for number in range(int(max(sizes, default=1)) + 1))
    made: dict[str, Any] = {
        "name": re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", kind.__name__).lower(),
        "reach_bins": bins,
        "reach_unit": units.pop() if len(units) == 1 else "steps",
        "mishap": (kind.reward_terms[0], f"steps with less {kind.reward_terms[0]} than 0"),
        "counterparts": (None,) * len(visual[0].items),
        "symbol_sizes": {
            name: sum(len(levels or (0,)) for levels in each)
            for name, each in kind.levels_of_features().items()
        },
    }
    if kind.controls:
        made["actions"] = action_names(kind.controls)
    derived = [name for name in made if not kind.given(name)]
    for name in derived:
        setattr(kind, name, made[name])
    if not kind.given("partial_views"):
        middle = kind.reach_bins[len(kind.reach_bins) // 2]
        kind.partial_views = {"half_the_reach": (middle,) * len(kind.directions)}
        derived.append("partial_views")
    return frozenset(derived)

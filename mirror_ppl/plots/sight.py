"""The picture of what people see, in whatever domain has one."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from mirror_ppl.plots import driving, search_rescue
from mirror_ppl.plots.picture import Picture

if TYPE_CHECKING:
    import arviz as az

PICTURES: dict[
    str, tuple[Callable[[az.InferenceData], bool], Callable[[az.InferenceData], Picture], str]
] = {
    "driving": (driving.has_sight, driving.sight_picture, "the road as each person sees it"),
    "search_rescue": (
        search_rescue.has_sight,
        search_rescue.sight_picture,
        "the house as each person sees it",
    ),
}
"""By domain: whether a posterior can be drawn, what draws it, and what is to be seen there."""


def sight_picture(data: az.InferenceData) -> tuple[Picture, str] | None:
    """What each person sees, and that in words; ``None`` if there is no picture of such sight."""
    known = PICTURES.get(str(data["posterior"].attrs.get("domain", "")))
    if known is None or not known[0](data):
        return None
    return known[1](data), known[2]

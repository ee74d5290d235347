"""The pictures of what people see, in whatever domain has some."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mirror_ppl.plots import driving, notices, reach, road_samples, search_rescue
from mirror_ppl.plots.picture import Picture

if TYPE_CHECKING:
    import arviz as az


@dataclass(frozen=True)
class SightPicture:
    """A picture of what people see.

    Attributes:
        possible: whether a posterior can be drawn so.
        draw: draws it.
        shows: what is to be seen, in words.
    """

    possible: Callable[[az.InferenceData], bool]
    draw: Callable[[az.InferenceData], Picture]
    shows: str


NOTICES = SightPicture(
    notices.has_notices, notices.notices_picture, "how probably each person notices what is there"
)
PICTURES: dict[str, dict[str, SightPicture]] = {
    "driving": {
        "sight.png": SightPicture(
            driving.has_sight, driving.sight_picture, "the road as each person sees it"
        ),
        "samples.png": SightPicture(
            road_samples.has_sight,
            road_samples.samples_picture,
            "the same in samples, beside what they really see",
        ),
        "notices.png": NOTICES,
    },
    "search_rescue": {
        "sight.png": SightPicture(
            search_rescue.has_sight,
            search_rescue.sight_picture,
            "the house as each person sees it",
        ),
    },
    "bomb_defusal": {"notices.png": NOTICES},
}
"""By domain and file name."""
OF_ANY_WORLD = {
    "sight.png": SightPicture(reach.has_reach, reach.reach_picture, "how far each person sees"),
    "notices.png": NOTICES,
}
"""By file name, of worlds that have no pictures of their own."""
FILES = tuple(sorted({name for own in PICTURES.values() for name in own}))
"""All names that there are."""


def sight_pictures(data: az.InferenceData) -> dict[str, tuple[Picture, str]]:
    """What each person sees, and that in words, by file name; nothing of sight of other kinds."""
    return {
        name: (picture.draw(data), picture.shows)
        for name, picture in pictures_of(data).items()
        if picture.possible(data)
    }


def pictures_of(data: az.InferenceData) -> dict[str, SightPicture]:
    """The pictures of sight that there are of the world of a posterior, by file name."""
    return PICTURES.get(str(data["posterior"].attrs.get("domain", "")), OF_ANY_WORLD)

"""The pictures of what people see, in whatever domain has some."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mirror_ppl.domains import Record, get_domain
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.plots import reach
from mirror_ppl.plots.notices import NOTICES_PICTURE
from mirror_ppl.plots.picture import Picture, SightPicture

if TYPE_CHECKING:
    import arviz as az


FILES = ("notices.png", "samples.png", "sight.png")
"""Names that pictures of what people see may have."""
OF_ANY_WORLD: Mapping[str, SightPicture] = {
    "sight.png": SightPicture(reach.has_reach, reach.reach_picture, "how far each person sees"),
    "notices.png": NOTICES_PICTURE,
}
"""By file name, of worlds that have no pictures of their own."""


def sight_pictures(data: az.InferenceData) -> dict[str, tuple[Picture, str]]:
    """What each person sees, and that in words, by file name; nothing of sight of other kinds."""
    return {
        name: (picture.draw(data), picture.shows)
        for name, picture in pictures_of(data).items()
        if picture.possible(data)
    }


def pictures_of(data: az.InferenceData) -> Mapping[str, SightPicture]:
    """The pictures of sight that there are of the world of a posterior, by file name."""
    return record_of(data).part("pictures") or OF_ANY_WORLD


def record_of(data: az.InferenceData) -> Record:
    """What is known of the world of a posterior; nothing of one that is not known here."""
    try:
        return get_domain(str(data["posterior"].attrs.get("domain", ""))).record
    except UnknownNameError:
        return Record()

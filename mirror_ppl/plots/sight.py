"""Figures of what people see, for every domain that has some."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mirror_ppl.domains import Record, get_domain
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.models.simulation import OWN_SIGHT
from mirror_ppl.plots import reach
from mirror_ppl.plots.notices import NOTICES_PICTURE
from mirror_ppl.plots.picture import Picture, SightPicture
from mirror_ppl.plots.reading import TITLE

if TYPE_CHECKING:
    import arviz as az


FILES = ("notices.png", "samples.png", "sight.png")
"""File names that pictures of what people see may have."""
OF_ANY_WORLD: Mapping[str, SightPicture] = {
    "sight.png": SightPicture(reach.has_reach, reach.reach_picture, "how far each person sees"),
    "notices.png": NOTICES_PICTURE,
}
"""Pictures by file name, for worlds that have none of their own."""


def sight_pictures(data: az.InferenceData) -> dict[str, SightPicture]:
    """Pictures of what each person sees that can be drawn, by file name."""
    return {name: picture for name, picture in pictures_of(data).items() if picture.possible(data)}


def drawn(picture: SightPicture, data: az.InferenceData) -> Picture:
    """Draw a picture of sight; its title says so if a user's human model has its own sight."""
    figure, attributes = picture.draw(data), data["posterior"].attrs
    if picture.thresholds and (method := attributes.get(OWN_SIGHT)):
        own = f"{attributes['human_model']}.{method}()"
        lines = (figure.get_suptitle(), f"Thresholds alone: {own} may change what people see")
        figure.suptitle("\n".join(lines), **TITLE)
    return figure


def pictures_of(data: az.InferenceData) -> Mapping[str, SightPicture]:
    """Pictures of sight for a posterior's world, by file name."""
    return record_of(data).part("pictures") or OF_ANY_WORLD


def record_of(data: az.InferenceData) -> Record:
    """Record of a posterior's world; an empty one if the world is unknown here."""
    try:
        return get_domain(str(data["posterior"].attrs.get("domain", ""))).record
    except UnknownNameError:
        return Record()

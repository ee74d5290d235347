"""Figures of a fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from mirror_ppl.errors import InputError
from mirror_ppl.inference.results.identifiability import NEGLIGIBLE
from mirror_ppl.plots import sight
from mirror_ppl.plots.identifiability import plot_identifiability
from mirror_ppl.plots.implants import plot_implants
from mirror_ppl.plots.model_check import plot_model_check
from mirror_ppl.plots.picture import Picture

if TYPE_CHECKING:
    import arviz as az

IDENTIFIABILITY, CHECK = "identifiability.png", "check.png"
FILES = (*sight.FILES, CHECK, IDENTIFIABILITY)
"""Names of all picture files that a fit may write."""


class FitPlots:
    """Draws figures of a fit; notebooks show what its methods return.

    Args:
        data: the fit.
    """

    def __init__(self, data: az.InferenceData) -> None:
        self.data = data

    def __repr__(self) -> str:
        names = [name for name in vars(FitPlots) if not name.startswith("_") and name != "files"]
        return f"FitPlots({', '.join(names)})"

    def sight(self) -> Picture:
        """Draw what each person sees: the road, the house, or probabilities of noticing items.

        Raises:
            InputError: there is no such picture of this world and human model.
        """
        return self._of_sight("sight.png", "notices.png")

    def samples(self) -> Picture:
        """Draw posterior samples of what each person sees, beside the truth where it is known.

        Raises:
            InputError: there is no such picture of this world and human model.
        """
        return self._of_sight("samples.png")

    def implants(self, person: str) -> Picture:
        """Draw each implant of a person that is one number: posterior beside prior.

        Raises:
            UnknownNameError: no person has that id.
        """
        return plot_implants(self.data, person)

    def identifiability(self) -> Picture:
        """Draw posterior entropy of the perceptual implants, and the most informative scenarios.

        Raises:
            InputError: the data identify all perceptual implants, or none of them is discrete, or
                perception reads a continuous one.
        """
        if "identifiability" not in self.data.groups():
            raise InputError(
                "of what these people see, entropies are not computed: perception reads a "
                "continuous site, or none"
            )
        if not self._has_identifiability():
            raise InputError("nothing about what these people see is left to identify")
        return plot_identifiability(self.data)

    def check(self) -> Picture:
        """Draw the model check of each person, see :func:`plot_model_check`.

        Raises:
            InputError: there were no training rounds, so nothing was checked.
        """
        if not self.data["model_check"].sizes["check"]:
            raise InputError("without training rounds there is nothing to check")
        return plot_model_check(self.data)

    def predictive_check(self) -> Picture:
        """Draw people's actions beside the model's predictions; for drivers, changes of lane.

        Raises:
            InputError: there is no such picture of this world.
        """
        return self._of_rounds("predictive_check")(self.data)

    def round(self, person: str, number: int, *, held_out: bool = False) -> Picture:
        """Draw one round over time, see :func:`mirror_ppl.domains.driving.rounds.plot_round`.

        Raises:
            InputError: there is no such picture of this world.
            UnknownNameError: no person has that id, or there is no such round.
        """
        return self._of_rounds("round")(self.data, person, number, held_out=held_out)

    def files(self) -> Iterator[tuple[str, Picture, str]]:
        """Draw the pictures that a fit writes, each with its file name and description."""
        for name, picture in sight.sight_pictures(self.data).items():
            yield name, sight.drawn(picture, self.data), picture.shows
        if self.data["model_check"].sizes["check"]:
            yield CHECK, self.check(), "whether the model explains each person"
        if self._has_identifiability():
            shows = "posterior entropy of what they see"
            if self.data["identifiability"].sizes.get("scenario"):
                shows += ", and the most informative scenarios"
            yield IDENTIFIABILITY, plot_identifiability(self.data), shows

    def _has_identifiability(self) -> bool:
        if "identifiability" not in self.data.groups():
            return False
        group = self.data["identifiability"]
        found = [group[name].values for name in ("entropy_together", "information")]
        return any((values >= NEGLIGIBLE).any() for values in found)

    def _of_rounds(self, name: str) -> Callable[..., Picture]:
        known = sight.record_of(self.data).part("rounds")
        if name not in known:
            domain = self.data["posterior"].attrs.get("domain")
            raise InputError(f"there is no picture {name} of {domain}")
        return known[name]

    def _of_sight(self, *names: str) -> Picture:
        known = sight.pictures_of(self.data)
        for name in names:
            if name in known and known[name].possible(self.data):
                return sight.drawn(known[name], self.data)
        raise InputError(
            f"there is no picture {names[0].removesuffix('.png')} of "
            f"{self.data['posterior'].attrs.get('human_model')} in "
            f"{self.data['posterior'].attrs.get('domain')}; implants(person) draws any human model"
        )

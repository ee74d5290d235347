"""Access of figures to an ``InferenceData`` of :mod:`mirror_ppl.inference.results.export`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, Normal, Stroke

from mirror_ppl.domains import require_known
from mirror_ppl.errors import DemonstrationsError
from mirror_ppl.inference.results.criticism import FINE
from mirror_ppl.plots.picture import label_of

if TYPE_CHECKING:
    import arviz as az

SAMPLE = ("chain", "draw")
TRUTH = "truth_"

# Okabe and Ito's colours, which people of any colour vision can distinguish.
BLUE, ORANGE, PURPLE, BLACK, GREY = "#0072B2", "#E69F00", "#CC79A7", "#000000", "#8a8a8a"
POSTERIOR, PRIOR, TRUE, OBSERVED = BLUE, GREY, ORANGE, BLACK
TITLE: dict[str, Any] = {"x": 0.01, "ha": "left", "fontsize": 14, "fontweight": "bold"}
"""How the title of a picture of people is written."""


def edged(width: float = 3.2, colour: str = "white") -> list[AbstractPathEffect]:
    """Return effects that draw a line on a wider one, so that it is seen on any colour."""
    return [Stroke(linewidth=width, foreground=colour), Normal()]


def people(data: az.InferenceData) -> list[str]:
    """Ids of the P people."""
    return [str(person) for person in data["posterior"]["person"].values]


def of_person(data: az.InferenceData, group: str, person: str) -> xr.Dataset:
    """Select one person's variables of a group.

    Raises:
        UnknownNameError: no person has that id.
    """
    known = people(data)
    return data[group].isel(person=known.index(require_known(person, "person", known)))


def name_of(data: az.InferenceData, person: str, apart: str = " ") -> str:
    """Label of a person, with the model check's verdict if that is suspect or unexplained.

    Args:
        data: the fit.
        person: id.
        apart: between the two.
    """
    name, checked = label_of(person), data["model_check"] if "model_check" in data.groups() else {}
    verdict = "" if "verdict" not in checked else str(checked["verdict"].sel(person=person).item())
    return name if verdict in ("", *FINE) else f"{name}{apart}({verdict})"


def draws(values: xr.DataArray) -> np.ndarray:
    """Join the draws of a variable, chains one after the other, ``[S, ...]``."""
    ordered = values.transpose(*SAMPLE, ...).values
    return ordered.reshape(-1, *ordered.shape[len(SAMPLE) :])


def truth(data: az.InferenceData, name: str, person: str) -> float | None:
    """True value of a simulated person's implant; ``None`` where it is not known."""
    constants = of_person(data, "constant_data", person)
    if TRUTH + name not in constants:
        return None
    value = float(constants[TRUTH + name])
    return None if np.isnan(value) else value


def round_of(dataset: xr.Dataset, dimension: str, number: int) -> xr.Dataset:
    """Select one round of a person.

    Args:
        dataset: the person's, with ``observed_action``, which is -1 in padding.
        dimension: ``"round"`` or ``"test_round"``.
        number: the round, counted from 0.

    Raises:
        DemonstrationsError: the person has no such round.
    """
    recorded = (dataset["observed_action"] >= 0).any("step").sum().item()
    if not 0 <= number < recorded:
        raise DemonstrationsError(
            f"there is no round {number} of {dataset['person'].item()}, "
            f"expected one of {recorded}, counted from 0"
        )
    return dataset.isel({dimension: number})


def label_columns(axes: Iterable[Axes], titles: Iterable[str]) -> None:
    """Set titles above the first row of panels."""
    for ax, title in zip(axes, titles, strict=True):
        ax.set_title(title, fontsize=10, loc="left")


def explain(figure: Figure, data: az.InferenceData, title: str, shown: int, legend: str) -> None:
    """Set the title above a figure of people, and the legend of its colours below it.

    Args:
        figure: the figure.
        data: the fit that it shows.
        title: its title.
        shown: number of people that it shows, from the first on.
        legend: of its colours.
    """
    setting = data["posterior"].attrs.get("setting")
    everybody = len(people(data))
    some = "" if shown == everybody else f" (the first {shown} of {everybody} people)"
    figure.suptitle(f"{title}{f', {setting}' if setting else ''}{some}", **TITLE)
    figure.supxlabel(legend, x=0.01, ha="left", fontsize=9)

"""Figures, as functions of ArviZ and xarray objects.

They draw on figures of their own (or on axes that are passed in) and leave matplotlib's global
state alone, so they work in notebooks, in scripts and without a display alike. Nothing of it is
imported before it is used.
"""

from typing import TYPE_CHECKING as _TYPE_CHECKING

from mirror_ppl.lazy import lazily as _lazily

if _TYPE_CHECKING:
    from mirror_ppl.plots.calibration import plot_coverage, plot_ecdf, plot_ranks
    from mirror_ppl.plots.communication import plot_action, plot_utilities
    from mirror_ppl.plots.comparison import plot_comparison
    from mirror_ppl.plots.fit import FitPlots
    from mirror_ppl.plots.identifiability import plot_identifiability
    from mirror_ppl.plots.implants import plot_implants, scalar_implants
    from mirror_ppl.plots.model_check import plot_model_check
    from mirror_ppl.plots.notices import notices_picture
    from mirror_ppl.plots.picture import Picture, SightPicture
    from mirror_ppl.plots.reach import reach_picture
    from mirror_ppl.plots.study import plot_curves, plot_relevance

__all__ = [
    "FitPlots",
    "Picture",
    "SightPicture",
    "notices_picture",
    "plot_action",
    "plot_comparison",
    "plot_coverage",
    "plot_curves",
    "plot_ecdf",
    "plot_identifiability",
    "plot_implants",
    "plot_model_check",
    "plot_ranks",
    "plot_relevance",
    "plot_utilities",
    "reach_picture",
    "scalar_implants",
]

_PLACES = {
    "FitPlots": "fit",
    "Picture": "picture",
    "SightPicture": "picture",
    "notices_picture": "notices",
    "plot_action": "communication",
    "plot_comparison": "comparison",
    "plot_coverage": "calibration",
    "plot_curves": "study",
    "plot_ecdf": "calibration",
    "plot_identifiability": "identifiability",
    "plot_implants": "implants",
    "plot_model_check": "model_check",
    "plot_ranks": "calibration",
    "plot_relevance": "study",
    "plot_utilities": "communication",
    "reach_picture": "reach",
    "scalar_implants": "implants",
}

__getattr__ = _lazily(__name__, _PLACES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

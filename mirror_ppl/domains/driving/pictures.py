"""The pictures of a fit to drivers."""

from mirror_ppl.domains.driving import road, rounds, samples
from mirror_ppl.plots.notices import NOTICES_PICTURE
from mirror_ppl.plots.picture import SightPicture

PICTURES = {
    "sight.png": SightPicture(
        road.has_sight, road.sight_picture, "the road as each person sees it"
    ),
    "samples.png": SightPicture(
        samples.has_sight,
        samples.samples_picture,
        "posterior samples of that road, beside what they really see where that is known",
    ),
    "notices.png": NOTICES_PICTURE,
}
"""Pictures of each person's sight, by file name."""
ROUNDS = {
    "round": rounds.plot_round,
    "predictive_check": rounds.plot_predictive_check,
}
"""Pictures of rounds, by method of :class:`mirror_ppl.plots.fit.FitPlots`."""

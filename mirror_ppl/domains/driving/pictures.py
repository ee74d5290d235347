"""The pictures of drivers that a fit has."""

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
        "the same in samples, beside what they really see",
    ),
    "notices.png": NOTICES_PICTURE,
}
"""Of what each person sees, by file name."""
ROUNDS = {
    "round": rounds.plot_round,
    "predictive_check": rounds.plot_predictive_check,
}
"""Of rounds, by the method of :class:`mirror_ppl.plots.fit.FitPlots` that draws them."""

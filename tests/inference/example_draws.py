"""How many draws are looked at, and how far their mean may be off."""

from scipy import stats

from mirror_ppl.inference.engines import InferenceOptions
from mirror_ppl.inference.svi import SVIOptions

DRAWS = 400


def options_of(guide):
    return InferenceOptions(guide, DRAWS, SVIOptions(steps=400) if guide == "svi" else None)


def bound(variance, draws):
    """What a mean of draws may be off by once in a million."""
    return -stats.norm.ppf(5e-7) * (variance / draws) ** 0.5

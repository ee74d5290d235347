"""Engines, which infer a human model's implants from rounds, and what is done with posteriors.

An engine is one of `ENGINES`: `auto`, `importance`, `amortized`, `svi` or `nuts`. `infer` runs one
of them; most users call `mirror_ppl.infer`, which also predicts, checks and describes. Nothing of
it is imported before it is used.
"""

from typing import TYPE_CHECKING as _TYPE_CHECKING

from mirror_ppl.lazy import lazily as _lazily

if _TYPE_CHECKING:
    from mirror_ppl.inference.adaptive_importance import ImportanceOptions
    from mirror_ppl.inference.amortized import AmortizedOptions
    from mirror_ppl.inference.amortized_guide import AmortizedGuide
    from mirror_ppl.inference.automatic import AutomaticOptions
    from mirror_ppl.inference.calibration.ranks import Calibration
    from mirror_ppl.inference.calibration.study import CalibrationOptions, calibrate
    from mirror_ppl.inference.engine import Engine, Inferred, Job
    from mirror_ppl.inference.engines import ENGINES, InferenceOptions, infer
    from mirror_ppl.inference.nuts import NUTSOptions
    from mirror_ppl.inference.online import OnlinePosterior
    from mirror_ppl.inference.population.pooling import Pooling, Population
    from mirror_ppl.inference.results.posterior_file import PosteriorFile, load_posterior
    from mirror_ppl.inference.svi import SVIOptions
    from mirror_ppl.inference.workers import Workers

__all__ = [
    "AmortizedGuide",
    "AmortizedOptions",
    "AutomaticOptions",
    "Calibration",
    "CalibrationOptions",
    "ENGINES",
    "Engine",
    "ImportanceOptions",
    "InferenceOptions",
    "Inferred",
    "Job",
    "NUTSOptions",
    "OnlinePosterior",
    "Pooling",
    "Population",
    "PosteriorFile",
    "SVIOptions",
    "Workers",
    "calibrate",
    "infer",
    "load_posterior",
]

_PLACES = {
    "AmortizedGuide": "amortized_guide",
    "AmortizedOptions": "amortized",
    "AutomaticOptions": "automatic",
    "Calibration": "calibration.ranks",
    "CalibrationOptions": "calibration.study",
    "ENGINES": "engines",
    "Engine": "engine",
    "ImportanceOptions": "adaptive_importance",
    "InferenceOptions": "engines",
    "Inferred": "engine",
    "Job": "engine",
    "NUTSOptions": "nuts",
    "OnlinePosterior": "online",
    "Pooling": "population.pooling",
    "Population": "population.pooling",
    "PosteriorFile": "results.posterior_file",
    "SVIOptions": "svi",
    "Workers": "workers",
    "calibrate": "calibration.study",
    "infer": "engines",
    "load_posterior": "results.posterior_file",
}

__getattr__ = _lazily(__name__, _PLACES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

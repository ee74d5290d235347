"""The engine `auto`: the amortized guide where it is reliable, `importance` otherwise.

The network's draws of a person are kept if their importance weights are reliable; otherwise the
person is inferred by ``importance``, from the same views of their rounds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

from mirror_ppl.checks import real_number, require_kind
from mirror_ppl.inference import amortized, importance
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.amortized import AmortizedOptions, sample_amortized
from mirror_ppl.inference.amortized_guide import guide_screening
from mirror_ppl.inference.engine import Engine, Inferred, Job
from mirror_ppl.inference.importance import infer_by_importance
from mirror_ppl.inference.weighted import HIGH_PARETO_K, Weighted
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder


@dataclass(frozen=True)
class AutomaticOptions:
    """Settings of the engine `auto`.

    Attributes:
        amortized: settings of the amortized guide.
        importance: settings of adaptive importance sampling.
        enough: least effective draws of a person for the network's draws to be kept.
        pareto_k: largest Pareto k of a person's importance weights for them to be kept.
    """

    amortized: AmortizedOptions = AmortizedOptions()
    importance: ImportanceOptions = ImportanceOptions()
    enough: float = 200.0
    pareto_k: float = HIGH_PARETO_K

    def __post_init__(self) -> None:
        require_kind(self.amortized, AmortizedOptions, "amortized")
        require_kind(self.importance, ImportanceOptions, "importance")
        object.__setattr__(self, "enough", real_number(self.enough, "enough", 0))
        object.__setattr__(self, "pareto_k", real_number(self.pareto_k, "pareto_k", -inf))


def infer_automatically(job: Job) -> Inferred:
    """Infer each person by the network if there is one and its draws are reliable."""
    network, options = job.network, job.settings
    # Measurements are observed sites of the program, which the network does not read.
    if network is None or job.rounds.measurements:
        return importance.ENGINE.run(replace(job, settings=options.importance))

    proposing = replace(options.amortized, refine=job.refine)

    def first_pass(builder: ViewTableBuilder, first: ImportanceOptions) -> tuple[str, Weighted]:
        found = sample_amortized(builder.human, network, builder, proposing)
        if found.effective >= options.enough and found.pareto_k <= options.pareto_k:
            return amortized.ENGINE.name, found
        found = sample_importance(builder.human, builder.table(), first)
        return importance.ENGINE.name, found

    with_network = replace(job, screening=guide_screening(), settings=options.importance)
    return infer_by_importance(with_network, first_pass)


ENGINE = Engine(
    "auto",
    infer_automatically,
    AutomaticOptions,
    each_alone=True,
    pooled_draws=4000,
    takes_network=True,
)

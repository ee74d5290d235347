"""The engine `auto`: the network proposes where there is one, `importance` serves everyone else.

A person keeps what the network proposed if its importance weights can be relied on; otherwise that
person is inferred by ``importance`` at once, from the same views of their rounds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from mirror_ppl.inference import amortized, importance
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.amortized import AmortizedOptions, sample_amortized
from mirror_ppl.inference.amortized_guide import guide_screening
from mirror_ppl.inference.engine import Engine, Inferred, Job
from mirror_ppl.inference.importance import infer_by_importance
from mirror_ppl.inference.sampler import HIGH_PARETO_K, Weighted
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder


@dataclass(frozen=True)
class AutomaticOptions:
    """Settings of the engine `auto`.

    Attributes:
        amortized: of proposing by the network.
        importance: of adaptive importance sampling.
        enough: effective draws of a person below which the network's draws are not kept.
        pareto_k: of a person's importance weights above which they are not kept either.
    """

    amortized: AmortizedOptions = AmortizedOptions()
    importance: ImportanceOptions = ImportanceOptions()
    enough: float = 200.0
    pareto_k: float = HIGH_PARETO_K


def infer_automatically(job: Job) -> Inferred:
    """Person after person, each by the network if there is one and its draws can be relied on."""
    network, options = job.network, job.settings
    # What was measured is observed by the program, of which the network knows nothing.
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

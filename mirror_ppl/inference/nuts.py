"""The engine `nuts`: Hamiltonian Monte Carlo, a reference on small problems."""

from __future__ import annotations

from dataclasses import dataclass

import pyro
from pyro.infer import MCMC, NUTS
from pyro.infer.autoguide import init_to_median

from mirror_ppl.checks import whole_number
from mirror_ppl.inference.batches import in_batches
from mirror_ppl.inference.engine import Engine, Inferred, Job
from mirror_ppl.likelihood.compiled import Compiled
from mirror_ppl.likelihood.densities import PLATES
from mirror_ppl.models.prior import Draws, sample_sites
from mirror_ppl.progress import Report, silent
from mirror_ppl.randomness import forked, seed_everything


@dataclass(frozen=True)
class NUTSOptions:
    """Settings of Hamiltonian Monte Carlo.

    Attributes:
        warmup: discarded steps in which step sizes are adapted.
        tree_depth: largest depth of a trajectory's tree.
    """

    warmup: int = 200
    tree_depth: int = 6

    def __post_init__(self) -> None:
        for name in ("warmup", "tree_depth"):
            object.__setattr__(self, name, whole_number(getattr(self, name), name, 1))


def sample_nuts(
    compiled: Compiled, options: NUTSOptions, number: int, seed: int, report: Report = silent
) -> Draws:
    """Joint, autocorrelated draws ``[S, P, 1, ...]`` of all sites from one chain.

    Discrete sites are summed out while the chain runs, and drawn afterwards.

    Args:
        compiled: the program and the rounds to learn from.
        options: settings.
        number: number of draws S.
        seed: seed of all random draws.
        report: called with the number of steps.
    """
    total, done = options.warmup + number, 0

    def count(*_: object) -> None:
        nonlocal done
        done += 1
        report("sample", min(done, total), total, "")

    compiled.refuse_scales("nuts")
    report("sample", done, total, "")
    with forked(), pyro.validation_enabled(False):
        seed_everything(seed)
        kernel = NUTS(
            compiled.program,
            max_plate_nesting=PLATES,
            init_strategy=init_to_median,
            max_tree_depth=options.tree_depth,
        )
        chain = MCMC(kernel, number, options.warmup, hook_fn=count, disable_progbar=True)
        chain.run()
        drawn = compiled.sample_discrete(chain.get_samples(), number)
    return {name: drawn[name] for name in sample_sites(compiled.human, 1)}


def infer_by_nuts(job: Job) -> Inferred:
    """Infer all people of a batch in one chain."""

    def infer_batch(compiled: Compiled, part: Job) -> Inferred:
        return Inferred(sample_nuts(compiled, part.settings, part.draws, part.seed, part.report))

    return in_batches(job, infer_batch)


ENGINE = Engine(
    "nuts",
    infer_by_nuts,
    NUTSOptions,
    any_program=True,
)

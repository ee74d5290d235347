"""The engine `importance`: person after person, by weighted draws that are resampled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic

import torch

from mirror_ppl.checkpoints import read_checkpoint, save_checkpoint
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.engine import Engine, Inferred, Job
from mirror_ppl.inference.sampler import Weighted
from mirror_ppl.inference.second_look import coarse, looks_twice, second_look
from mirror_ppl.likelihood.tables import person_builders, rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.measured import measured_draws
from mirror_ppl.models.prior import Draws, sample_sites

SECONDS_BETWEEN_CHECKPOINTS = 10.0


def infer_by_importance(
    job: Job,
    first_pass: Callable[[ViewTableBuilder, ImportanceOptions], tuple[str, Weighted]] | None = None,
) -> Inferred:
    """Person after person.

    Args:
        job: what to infer.
        first_pass: weighted draws of what the rounds of a person say, and which engine they are
            from; adaptive importance sampling unless given.
    """
    first_pass = first_pass or _by_importance
    people = job.rounds.num_people
    done = _People() if job.checkpoint is None else _People.restored(*job.checkpoint)
    saved = monotonic()
    with torch.random.fork_rng(devices=[]):
        job.report("infer", len(done), people, "people")
        for builder in person_builders(job.human, job.rounds, job.screening, first=len(done)):
            human, person = builder.human, len(done)
            # Whatever the number of draws that others took.
            torch.manual_seed((job.seed + 1) * 1_000_003 + person)
            first = coarse(job.settings) if looks_twice(human) else job.settings
            engine, found = first_pass(builder, first)
            if looks_twice(human):
                rounds = rounds_of(job.rounds, person)
                builder, found = second_look(
                    human, rounds, job.screening, job.settings, builder, found
                )
            drawn = found.sample(job.draws, builder.grid)
            if job.rounds.measurements:
                drawn |= measured_draws(job.rounds.select_people([person]), job.draws)
            done.draws.append(drawn)
            done.pareto_k.append(found.pareto_k)
            done.engines.append(engine)
            if job.checkpoint is not None and monotonic() - saved > SECONDS_BETWEEN_CHECKPOINTS:
                done.save(*job.checkpoint)
                saved = monotonic()
            job.report("infer", len(done), people, "people")
        order = sample_sites(job.human, 1)
    # Site after site, so that draws of pooled people, which are many, are not in memory twice.
    draws = {name: torch.cat([own.pop(name) for own in done.draws], 1) for name in order}
    return Inferred(draws, torch.tensor(done.pareto_k), engines=tuple(done.engines))


def _by_importance(builder: ViewTableBuilder, options: ImportanceOptions) -> tuple[str, Weighted]:
    return ENGINE.name, sample_importance(builder.human, builder.table(), options)


@dataclass(frozen=True)
class _People:
    """Those who are done."""

    draws: list[Draws] = field(default_factory=list)
    pareto_k: list[float] = field(default_factory=list)
    engines: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.draws)

    def save(self, path: Path, run: str) -> None:
        save_checkpoint(path, run, vars(self))

    @classmethod
    def restored(cls, path: Path, run: str) -> _People:
        if not path.exists():
            return cls()
        content = read_checkpoint(path, run)
        return cls(content["draws"], content["pareto_k"], content["engines"])


ENGINE = Engine(
    "importance",
    infer_by_importance,
    ImportanceOptions,
    pooled_draws=4000,
)

"""The engine `importance`: adaptive importance sampling of each person, with resampling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import nan

import torch

from mirror_ppl.inference.adaptive_importance import ImportanceOptions, coarse, sample_importance
from mirror_ppl.inference.engine import Engine, Inferred, Job
from mirror_ppl.inference.kinds import infer_kinds, models_by_kind
from mirror_ppl.inference.point_proposals import with_points_near
from mirror_ppl.inference.second_look import looks_twice, second_look
from mirror_ppl.inference.weighted import Weighted
from mirror_ppl.likelihood.densities import adds_to_prior
from mirror_ppl.likelihood.tables import person_builders, rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.measured import measured_draws
from mirror_ppl.models.prior import sample_sites
from mirror_ppl.randomness import forked, seed_everything
from mirror_ppl.timing import stage


def infer_by_importance(
    job: Job,
    first_pass: Callable[[ViewTableBuilder, ImportanceOptions], tuple[str, Weighted]] | None = None,
) -> Inferred:
    """Infer each person in turn by importance sampling.

    Args:
        job: people, rounds and settings.
        first_pass: returns the engine's name and weighted draws of a person; adaptive importance
            sampling by default.
    """
    estimated = has_evidence(job.human) and not job.rounds.measurements
    models = models_by_kind(job.human) if first_pass is None and estimated else {}
    if models:
        return infer_kinds(job, models, infer_by_importance)
    first_pass = first_pass or _by_importance
    if job.screening is None:  # nothing is merged; pruning has a setting of its own
        job = replace(job, settings=replace(job.settings, resolution=0.0))
    people, found, drawn = job.rounds.num_people, [], []
    with forked():
        builders = person_builders(job.human, job.rounds, job.screening)
        for person in range(people):
            job.report("infer", person, people, "people")
            with stage("compile"):
                builder = next(builders)
            human = builder.human
            # Independent of other people, and of how many draws they took.
            seed_everything(job.seed_of(person))
            points = builder.grid.is_points
            again = looks_twice(human) or points
            first = coarse(job.settings) if again else job.settings
            engine, own = first_pass(builder, first)
            if looks_twice(human):
                rounds = rounds_of(job.rounds, person)
                builder, own = second_look(human, rounds, job.screening, job.settings, builder, own)
            elif points:
                rounds = [rounds_of(job.rounds, person)]
                builder, own = with_points_near(builder, own, rounds, job.screening, job.settings)
            draws = own.sample(job.draws, builder.grid)
            if job.rounds.measurements:
                draws |= measured_draws(job.rounds.select_people([person]), job.draws)
            evidence = (own.log_evidence, own.evidence_error) if estimated else (nan, nan)
            found.append((own.pareto_k, *evidence, engine, own.probable))
            drawn.append(draws)
        order = sample_sites(job.human, 1)
    job.report("infer", people, people, "people")
    # Site by site, so that the many draws of pooled people are not in memory twice.
    joined = {name: torch.cat([own.pop(name) for own in drawn], 1) for name in order}
    pareto_k, evidence, error, engines, combinations = zip(*found, strict=True)
    weighed = (torch.tensor(pareto_k), torch.tensor(evidence), torch.tensor(error))
    # Numbers of points mean nothing to others.
    return Inferred(
        joined, *weighed, () if builder.grid.is_points else combinations, engines=engines
    )


def has_evidence(human: HumanModel) -> bool:
    """True if averages of importance weights estimate a marginal likelihood of actions.

    They do not if the program has factors, observed sites, scales or masks, nor if attention is
    sampled, which adds noise that their standard error does not include.
    """
    added = adds_to_prior(human) or dependencies(human).adds_to_rounds
    return not (added or looks_twice(human))


def _by_importance(builder: ViewTableBuilder, options: ImportanceOptions) -> tuple[str, Weighted]:
    return ENGINE.name, sample_importance(builder.human, builder.table(), options)


ENGINE = Engine(
    "importance",
    infer_by_importance,
    ImportanceOptions,
    each_alone=True,
    pooled_draws=4000,
)

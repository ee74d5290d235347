"""Batches for engines that infer several people together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from mirror_ppl.checkpoints import read_checkpoint
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, coarse
from mirror_ppl.inference.engine import Inferred, Job
from mirror_ppl.inference.importance import infer_by_importance
from mirror_ppl.inference.second_look import LIKELY_DRAWS, looks_twice
from mirror_ppl.likelihood.compiled import Compiled, Sequential, compile
from mirror_ppl.models.human import has_own_program
from mirror_ppl.models.measured import alike_measured, measured_draws
from mirror_ppl.models.prior import Draws, sample_sites

PEOPLE_AT_ONCE = 50
"""People whose views are in memory together; they do not depend on each other."""


def in_batches(job: Job, infer_batch: Callable[[Compiled, Job], Inferred]) -> Inferred:
    """Infer people in batches whose views fit into memory.

    Args:
        job: people, rounds and settings.
        infer_batch: infers some people, given their compiled program and rounds.
    """
    people, found, files = job.rounds.num_people, [], {}
    batches = [
        range(begin, min(begin + PEOPLE_AT_ONCE, some.stop))
        for some in alike_measured(job.rounds)
        for begin in range(some.start, some.stop, PEOPLE_AT_ONCE)
    ]
    if job.checkpoint is not None:
        path, run = job.checkpoint
        for begin in (some.start for some in batches):
            files[begin] = path.with_name(f"{path.name}.{begin}") if begin else path, run
            if files[begin][0].exists():  # refuses foreign checkpoints before any work
                read_checkpoint(*files[begin])
    for some in batches:
        begin, own = some.start, job.of(some)
        own = replace(own, seed=job.seed + begin, checkpoint=files.get(begin))
        job.report("views", begin, people, "people")
        compiled = compile(
            own.human,
            own.rounds,
            screening=own.screening,
            likely=_likely(replace(own, seed=job.seed)),
            report=lambda done, begin=begin: job.report("views", begin + done, people, "people"),
        )
        if isinstance(compiled, Sequential) and compiled.joint and len(batches) > 1:
            raise HumanModelError(
                f'{type(job.human).__name__}.model ties people together by "{compiled.joint[0]}": '
                f"infer at most {PEOPLE_AT_ONCE} people at once, of whom the same was measured"
            )
        one = infer_batch(compiled, own)
        found.append(replace(one, draws={**one.draws, **measured_draws(own.rounds, job.draws)}))
    order = sample_sites(job.human, 1)
    draws = {name: torch.cat([one.draws[name] for one in found], 1) for name in order}
    losses = tuple(sum(step) for step in zip(*(one.losses for one in found), strict=True))
    return Inferred(draws, losses=losses)


def _likely(job: Job) -> Draws | None:
    """Approximate posterior draws, if values of attention are sampled by them."""
    if has_own_program(job.human) or not looks_twice(job.human):
        return None
    settings = coarse(ImportanceOptions())
    first = replace(job, draws=LIKELY_DRAWS, settings=settings, checkpoint=None)
    return dict(infer_by_importance(first).draws)

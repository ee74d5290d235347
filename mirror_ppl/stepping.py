"""Environments of worlds that are stepped, in several processes where a step takes long."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from typing import TYPE_CHECKING, cast

from mirror_ppl.domains import Domain
from mirror_ppl.domains.registry import code_of
from mirror_ppl.workers import pickled, run_tasks

if TYPE_CHECKING:
    from mirror_ppl.domains.stepped_world import Outcome, SteppedWorld, Trial

KEPT = 4
"""Number of worlds whose environments a process keeps."""


@contextmanager
def stepped_by(jobs: int, domain: Domain) -> Iterator[None]:
    """Step the environment of a world in several processes; the outcomes are the same.

    Nothing changes in worlds that are not stepped, and where a batch of steps is soon done.

    Args:
        jobs: number of processes; 1 for this one, -1 for one per core.
        domain: any world; it must not be used in another thread.
    """
    from joblib import effective_n_jobs

    from mirror_ppl.domains.stepped_world import SteppedWorld

    number = effective_n_jobs(jobs)
    if number == 1 or not isinstance(domain, SteppedWorld):
        yield
        return
    code_of(domain)  # other processes may not have its file
    domain.elsewhere = partial(_shared, number, pickled(domain))
    try:
        yield
    finally:
        domain.elsewhere = None


def _shared(jobs: int, own: bytes, trials: Sequence[Trial]) -> list[Outcome]:
    """Return what follows each trial, computed by ``jobs`` processes."""
    parts = [trials[place::jobs] for place in range(jobs)]
    tasks = [partial(_outcomes, own, place, part) for place, part in enumerate(parts) if part]
    found: list[Outcome | None] = [None] * len(trials)
    for place, outcomes in run_tasks(tasks, jobs):
        found[place::jobs] = outcomes
    return cast("list[Outcome]", found)


def _outcomes(own: bytes, place: int, trials: Sequence[Trial]) -> tuple[int, list[Outcome]]:
    return place, _world(own).outcomes(trials)


@lru_cache(KEPT)
def _world(own: bytes) -> SteppedWorld:
    """Return the world of this process, whose environment is made once."""
    return pickle.loads(own)

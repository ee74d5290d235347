"""Environments of worlds that are stepped, in several processes where a step takes long."""

from __future__ import annotations

import pickle
import secrets
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from mirror_ppl.domains import Domain
from mirror_ppl.domains.registry import code_of
from mirror_ppl.errors import DomainError
from mirror_ppl.user_code import describe
from mirror_ppl.workers import pickled, run_tasks

if TYPE_CHECKING:
    from mirror_ppl.domains.stepped_world import Outcome, SteppedWorld, Trial

KEPT = 4
"""Number of worlds whose environments a process keeps."""


@contextmanager
def stepped_by(jobs: int, domain: Domain) -> Iterator[None]:
    """Step the environment of a world in several processes; the outcomes are the same.

    Nothing changes in worlds that are not stepped, and where steps are soon done. Where other
    processes fail, a warning says why, and the world is stepped in this one.

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
    vars(domain)["elsewhere"] = _Elsewhere(number, domain)
    try:
        yield
    finally:
        vars(domain)["elsewhere"] = None


class _Elsewhere:
    """Outcomes of a world, computed by other processes."""

    def __init__(self, jobs: int, world: SteppedWorld) -> None:
        self.jobs, self.world = jobs, world

    @cached_property
    def _own(self) -> bytes:
        code_of(self.world)  # other processes may not have its file
        # The number: processes that go on to the next run make the environment anew.
        return pickled((secrets.token_bytes(8), self.world))

    def __call__(self, trials: Sequence[Trial]) -> list[Outcome]:
        """Return what follows each trial."""
        try:
            return self._shared(trials)
        except DomainError:  # the world is at fault
            raise
        except Exception as error:
            vars(self.world)["elsewhere"] = None
            found = self.world.outcomes(trials)
            warnings.warn(
                f"{self.world.name} is stepped in one process, as others failed: {describe(error)}",
                stacklevel=2,
            )
            return found

    def _shared(self, trials: Sequence[Trial]) -> list[Outcome]:
        parts = [trials[place :: self.jobs] for place in range(self.jobs)]
        tasks = [
            partial(_outcomes, self._own, place, *_stacked(part))
            for place, part in enumerate(parts)
            if part
        ]
        found: list[Any] = [None] * len(trials)
        seconds = []
        for place, taken, reached, ends, earned in run_tasks(tasks, self.jobs):
            found[place :: self.jobs] = zip(reached, ends, earned, strict=True)
            seconds.append(taken)
        self.world.took(max(seconds))
        return found


def _stacked(trials: Sequence[Trial]) -> tuple[np.ndarray, Any, list[int]]:
    """Return trials as arrays, which are sent much faster."""
    rows, commands, seeds = zip(*trials, strict=True)
    alike = all(isinstance(command, np.ndarray) for command in commands)
    return np.array(rows), np.array(commands) if alike else commands, list(seeds)


def _outcomes(
    own: bytes, place: int, rows: np.ndarray, commands: Sequence[Any], seeds: Sequence[int]
) -> tuple[int, float, np.ndarray, list[bool], np.ndarray]:
    """Return the place, the seconds that an outcome took, and the parts of outcomes."""
    world = _world(own)
    found = world.outcomes(list(zip(rows, commands, seeds, strict=True)))
    reached, ends, earned = zip(*found, strict=True)
    return place, world.seconds, np.array(reached), list(ends), np.array(earned)


@lru_cache(KEPT)
def _world(own: bytes) -> SteppedWorld:
    """Return the world of this process, whose environment is made once."""
    return pickle.loads(own)[1]

"""Distribution of work on many people: in this process, in several, or on a cluster."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mirror_ppl.errors import InputError
from mirror_ppl.jobs import Runner, TensorFormat
from mirror_ppl.progress import Report, Reported, silent

PEOPLE_OF_A_PROCESS = 4
"""People per process for which starting a further process pays."""


def parts_of(checkpoint: Path) -> Path:
    """Folder in which a run with this checkpoint stores results of single people."""
    return checkpoint.with_name(f"{checkpoint.name}.parts")


@dataclass(frozen=True)
class PersonAt:
    """One of the people.

    Attributes:
        number: their place among the people, from 0.
    """

    number: int

    @property
    def label(self) -> str:
        """Name for progress reports."""
        return f"person {self.number + 1}"

    @property
    def range(self) -> range:
        """Their place as a range."""
        return range(self.number, self.number + 1)


@dataclass(frozen=True)
class Workers:
    """Processes or cluster for work on many people. Results do not depend on this choice.

    Attributes:
        jobs: processes; 1 for this one, -1 for one per core, ``None`` for a suitable number.
        scheduler: address of a Dask cluster to use instead.
        folder: folder for results of people who are done, from which a stopped run resumes.
        report: called with the number of people done.
    """

    jobs: int | None = 1
    scheduler: str | None = None
    folder: Path | None = None
    report: Report = silent

    def __post_init__(self) -> None:
        if self.jobs == 0:
            raise InputError("jobs must be at least 1, or -1 for one a core, not 0")

    def run(
        self,
        name: str,
        people: int,
        work: Callable[[Any], dict[str, Any]],
        given: Callable[[PersonAt], Any],
        identity: str = "",
    ) -> list[dict[str, Any]]:
        """Do some work on people 0 to P - 1, one by one.

        Thus processes end at about the same time, little is lost if they are stopped, and a
        person's results do not depend on the others.

        Args:
            name: name of the work.
            people: number of people P.
            work: picklable function of a person's input; returns tensors and plain values.
            given: makes the input of a person.
            identity: identifies everything that results depend on.

        Returns:
            Results of the people, in order.
        """
        cells = [PersonAt(number) for number in range(people)]
        runner = Runner(
            self.folder,
            lambda cell: f"{name} {identity}",
            self.processes(people),
            self.scheduler,
            progress=Reported(name, people, self.report),
        )
        outcomes = runner.run(cells, work, TensorFormat(), given)
        found = [outcome.result for outcome in outcomes]
        assert all(result is not None for result in found)
        return found  # pyright: ignore[reportReturnType] - none is None

    def clean(self) -> None:
        """Remove stored results."""
        Runner(self.folder).clean()

    def processes(self, people: int) -> int:
        """Number of processes on this machine for that many people."""
        if self.jobs is not None and self.jobs > 0:
            return self.jobs
        from joblib import cpu_count, effective_n_jobs

        if self.jobs is not None:
            return effective_n_jobs(self.jobs)
        return max(1, min(cpu_count(), math.ceil(people / PEOPLE_OF_A_PROCESS)))

"""Work on many people, part by part: in this process, in several, or on a cluster."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mirror_ppl.errors import InputError
from mirror_ppl.jobs import Runner, TensorFormat
from mirror_ppl.progress import Report, Reported, silent

PART = 2
"""People of a part: few, so that processes end at about the same time and little is lost when they
are stopped."""
PEOPLE_OF_A_PROCESS = 4
"""People that are worth the seconds in which a further process starts."""


def parts_of(checkpoint: Path) -> Path:
    """The folder in which a run with this checkpoint keeps what is done for some of the people."""
    return checkpoint.with_name(f"{checkpoint.name}.parts")


@dataclass(frozen=True)
class People:
    """Some of the people, one after the other.

    Attributes:
        first: number of the first one.
        last: of the one after the last one.
    """

    first: int
    last: int

    @property
    def label(self) -> str:
        """Who they are."""
        return f"people {self.first + 1} to {self.last}"

    @property
    def range(self) -> range:
        """Their numbers."""
        return range(self.first, self.last)


@dataclass(frozen=True)
class Workers:
    """Who does the work on many people. What comes of it does not depend on that.

    Attributes:
        jobs: processes; 1 for this one, -1 for one a core, ``None`` for as many as pay.
        scheduler: address of a Dask cluster that does the work instead.
        folder: where results of finished parts are kept, so that a run that is stopped goes on.
        report: told of people done.
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
        given: Callable[[People], Any],
        identity: str = "",
    ) -> list[dict[str, Any]]:
        """Do some work on people 0 to P - 1.

        Args:
            name: of the work.
            people: P.
            work: of what some of them need; can be pickled. Returns tensors and plain values.
            given: what the work needs of some of them.
            identity: of everything that results depend on.

        Returns:
            Results of the parts, in order.
        """
        # Of one size whoever does the work: what is computed together may differ in its last digit.
        cells = [People(first, min(first + PART, people)) for first in range(0, people, PART)]
        runner = Runner(
            self.folder,
            lambda cell: f"{name} {identity}",
            self._processes(people),
            self.scheduler,
            progress=Reported(name, people, PART, self.report),
        )
        outcomes = runner.run(cells, work, TensorFormat(), given)
        found = [outcome.result for outcome in outcomes]
        assert all(result is not None for result in found)
        return found  # pyright: ignore[reportReturnType] - none is None

    def clean(self) -> None:
        """Remove what was kept."""
        Runner(self.folder).clean()

    def _processes(self, people: int) -> int:
        if self.jobs is not None:
            return self.jobs
        from joblib import cpu_count

        return max(1, min(cpu_count(), math.ceil(people / PEOPLE_OF_A_PROCESS)))

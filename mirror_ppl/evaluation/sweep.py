"""Cells of work that run beside each other; a sweep that is stopped goes on where it was.

A cell is a frozen dataclass of plain values, and its result a list of rows. The rows of each are a
file of their own, named by what the cell is and what the work depends on. A cell that fails is
reported, and tried again by the next run; the others are not lost.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol, cast

from mirror_ppl.errors import OptionError, WorkerError
from mirror_ppl.files import write_whole
from mirror_ppl.user_code import describe
from mirror_ppl.workers import run_tasks

Rows = list[dict[str, Any]]
"""A table of plain values."""


class Cell(Protocol):
    """A frozen dataclass of plain values."""

    @property
    def label(self) -> str:
        """What it is, for people who wait."""
        ...


Report = Callable[[int, str], None]
"""Told how many cells are done, and which was the last."""


KILLED = "its process was killed; there may be too little memory for so many --jobs"
"""What is said of a cell that takes its process along."""


@dataclass(frozen=True)
class Outcome:
    """What came of a cell.

    Attributes:
        cell: which it is.
        rows: its result; none if it failed.
        seconds: that it took, by the process that did it.
        error: why it failed, and where.
    """

    cell: Cell
    rows: Rows = field(default_factory=list)
    seconds: float = 0.0
    error: str | None = None


def run_cells(
    cells: Sequence[Cell],
    work: Callable[[Any], Rows],
    folder: Path,
    identity: Callable[[Any], str],
    jobs: int = -1,
    scheduler: str | None = None,
    report: Report = lambda done, message: None,
    before: Callable[[int], None] = lambda done: None,
) -> list[Outcome]:
    """Do the work of every cell that is not done yet.

    Args:
        cells: in the order in which they are begun.
        work: of one cell; a function of a module, which other processes can find.
        folder: where rows of finished cells are kept; it is there.
        identity: of everything that the work of a cell depends on and that is not in the cell.
        jobs: processes on this machine; -1 for one a core.
        scheduler: address of a Dask cluster that does the work instead.
        report: told of progress.
        before: told how many cells earlier runs did, when work begins.

    Returns:
        One outcome a cell, in their order.

    Raises:
        OptionError: the cluster's library is not installed, or it cannot be reached.
    """
    outcomes: dict[int, Outcome] = {}
    names = [_name(cell, identity(cell)) for cell in cells]
    for place, (cell, name) in enumerate(zip(cells, names, strict=True)):
        kept = _kept(folder / name, cell)
        if kept is not None:
            outcomes[place] = kept
    before(len(outcomes))
    todo = [place for place in range(len(cells)) if place not in outcomes]
    with ExitStack() as stack:
        if scheduler is not None:
            stack.enter_context(_cluster(scheduler))

        def done(place: int, outcome: Outcome) -> None:
            outcomes[place] = outcome
            if outcome.error is None:
                _keep(folder / names[place], outcome)
            report(len(outcomes), outcome.cell.label + (" failed" if outcome.error else ""))

        def results(places: Sequence[int]) -> Iterator[tuple[int, Outcome]]:
            tasks = [partial(_cell, place, cells[place], work) for place in places]
            return run_tasks(tasks, jobs, here=scheduler is None)

        try:
            for place, outcome in results(todo):
                done(place, outcome)
        except Exception as error:
            if not _killed(error):
                raise
            # One of them takes its process along, and with it the others: now one at a time.
            for place in [place for place in todo if place not in outcomes]:
                try:
                    for _, outcome in results([place]):
                        done(place, outcome)
                except Exception as culprit:
                    if not _killed(culprit):
                        raise
                    done(place, Outcome(cells[place], error=KILLED))
    return [outcomes[place] for place in range(len(cells))]


def _killed(error: Exception) -> bool:
    """Whether a process ended without a word, of this machine or of a cluster."""
    return isinstance(error, WorkerError) or type(error).__name__ == "KilledWorker"


def _cell(place: int, cell: Cell, work: Callable[[Any], Rows]) -> tuple[int, Outcome]:
    began = perf_counter()
    try:
        rows = work(cell)
    except (Exception, SystemExit) as error:  # whatever it is, the other cells go on
        return place, Outcome(cell, seconds=perf_counter() - began, error=describe(error))
    return place, Outcome(cell, rows, perf_counter() - began)


def _cluster(address: str) -> ExitStack:
    """A context in which joblib's work is done by the workers of a Dask scheduler."""
    from joblib import parallel_config

    try:
        from distributed import Client
        from distributed.comm import connect
        from distributed.utils import LoopRunner
    except ImportError as error:
        raise OptionError(
            "--scheduler needs Dask: pip install 'mirror_ppl[cluster]', here and on the workers"
        ) from error

    async def reach() -> None:
        await (await connect(address, timeout=10)).close()

    with ExitStack() as stack:
        try:
            # A client that cannot connect would stay behind as what xarray asks for its locks.
            LoopRunner().run_sync(reach)
            client = stack.enter_context(Client(address, timeout="10s"))
        except (OSError, ValueError) as error:
            raise OptionError(f"--scheduler {address} cannot be reached: {error}") from error
        stack.enter_context(parallel_config(backend="dask", client=client))
        return stack.pop_all()


def _name(cell: Cell, identity: str) -> str:
    content = json.dumps([type(cell).__name__, asdict(cast(Any, cell)), identity], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:24] + ".json"


def _keep(path: Path, outcome: Outcome) -> None:
    content = {
        "cell": asdict(cast(Any, outcome.cell)),
        "seconds": outcome.seconds,
        "rows": outcome.rows,
    }
    write_whole(path, json.dumps(content, indent=1) + "\n")


def _kept(path: Path, cell: Cell) -> Outcome | None:
    """What an earlier run left of a cell; what is damaged counts as missing."""
    try:
        content = json.loads(path.read_text())
        return Outcome(cell, content["rows"], content["seconds"])
    except (OSError, ValueError, KeyError, TypeError):
        return None

"""Resumable work in cells: a run that was stopped continues where it was.

A cell is a frozen dataclass of plain values. Its result is kept in a file of its own, named by a
hash of the cell and of everything else that the result depends on. A file of another cell, another
version or other options is thus never taken for it, and a damaged file counts as missing.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar, cast

from mirror_ppl.checkpoints import checkpoint_content, read_checkpoint
from mirror_ppl.errors import MirrorError, PosteriorError, WorkerError
from mirror_ppl.files import Content, write_whole
from mirror_ppl.progress import Progress
from mirror_ppl.user_code import describe
from mirror_ppl.workers import cluster, run_tasks

if TYPE_CHECKING:
    import xarray as xr

Result = TypeVar("Result")

DISPATCHED = 2
"""Cells that have been dispatched per process when one of them kills its process."""
FILE = re.compile(r"[0-9a-f]{24}\.(json|nc|pt)")
"""Pattern of the names of result files."""


class Cell(Protocol):
    """A frozen dataclass of plain values."""

    @property
    def label(self) -> str:
        """Name in progress messages."""
        ...


class Format(Protocol[Result]):
    """File format of results."""

    suffix: str

    def write(self, result: Result, about: dict[str, Any]) -> Content:
        """Return a file's content for a result and plain values about it."""
        ...

    def read(self, path: Path) -> tuple[Result, dict[str, Any]]:
        """Read a result and the values about it; any exception if the file is damaged."""
        ...


class JsonFormat(Generic[Result]):
    """Results of plain values and dataclasses, as JSON.

    Args:
        decode: makes a result of plain values from JSON; they are the result unless given.
    """

    suffix = ".json"

    def __init__(self, decode: Callable[[Any], Result] = lambda content: content) -> None:
        self.decode = decode

    def write(self, result: Result, about: dict[str, Any]) -> str:
        """Return a file's content, see `Format`."""
        return json.dumps(about | {"result": result}, indent=1, default=asdict) + "\n"

    def read(self, path: Path) -> tuple[Result, dict[str, Any]]:
        """Read a result, see `Format`."""
        about = json.loads(path.read_text())
        return self.decode(about.pop("result")), about


class DatasetFormat:
    """Results that are xarray datasets, as netCDF."""

    suffix = ".nc"

    def write(self, result: xr.Dataset, about: dict[str, Any]) -> Content:
        """Return a file's content, see `Format`."""
        return result.assign_attrs(about=json.dumps(about)).to_netcdf(engine="h5netcdf")

    def read(self, path: Path) -> tuple[xr.Dataset, dict[str, Any]]:
        """Read a result, see `Format`."""
        from mirror_ppl.netcdf import read_netcdf

        data = read_netcdf(path, PosteriorError)["/"]
        return data, json.loads(data.attrs.pop("about"))


class TensorFormat:
    """Results that are dicts of tensors and plain values, as a checkpoint."""

    suffix = ".pt"

    def write(self, result: dict[str, Any], about: dict[str, Any]) -> Content:
        """Return a file's content, see `Format`."""
        return checkpoint_content("", {"result": result, "about": about})

    def read(self, path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
        """Read a result, see `Format`."""
        content = read_checkpoint(path, "")
        return content["result"], content["about"]


@dataclass(frozen=True)
class Outcome(Generic[Result]):
    """Outcome of a cell.

    Attributes:
        cell: the cell.
        result: of the work; ``None`` if it failed.
        seconds: of work in its process.
        error: why it failed, and where.
    """

    cell: Cell
    result: Result | None = None
    seconds: float = 0.0
    error: str | None = None


@dataclass(frozen=True)
class Runner:
    """Runs cells that are not finished yet.

    Attributes:
        folder: where results of finished cells are kept; none are kept unless given.
        identity: identifies everything besides a cell that its result depends on.
        jobs: processes on this machine; 1 for this one, -1 for one per core.
        scheduler: address of a Dask cluster that does the work instead.
        keep_going: when a cell fails, report it in its outcome and go on with the others, instead
            of ending with its exception. Results of finished cells are kept in both cases.
        progress: of cells.
    """

    folder: Path | None = None
    identity: Callable[[Any], str] = lambda cell: ""
    jobs: int = 1
    scheduler: str | None = None
    keep_going: bool = False
    progress: Progress = field(default_factory=lambda: Progress("work", quiet=True))

    def run(
        self,
        cells: Sequence[Cell],
        work: Callable[[Any], Result],
        form: Format[Result] | None = None,
        given: Callable[[Any], Any] | None = None,
    ) -> list[Outcome[Result]]:
        """Run every cell that is not finished yet.

        If a process is killed, the cells that may be the cause are tried again one at a time.

        Args:
            cells: in the order in which they are begun.
            work: of one cell; can be pickled if other processes do it.
            form: of results in files; JSON unless given.
            given: makes the argument of the work from the cell, when its turn comes.

        Returns:
            One outcome per cell, in their order.

        Raises:
            OptionError: the cluster's library is not installed, or it cannot be reached.
            WorkerError: a cell kills its process, unless `keep_going`.
        """
        form = JsonFormat() if form is None else form
        paths = [self._path(cell, form.suffix) for cell in cells]
        found = [_kept(path, cell, form) for path, cell in zip(paths, cells, strict=True)]
        outcomes = {place: kept for place, kept in enumerate(found) if kept is not None}
        self.progress.resume(len(outcomes))

        def task(place: int) -> Callable[[], tuple[int, Outcome[Result]]]:
            own = partial(work, cells[place] if given is None else given(cells[place]))
            return partial(_done, place, cells[place], own, self.keep_going)

        todo = [place for place in range(len(cells)) if place not in outcomes]
        with nullcontext() if self.scheduler is None else cluster(self.scheduler):
            for place, outcome in self._each(todo, task):
                cell, path = outcome.cell, paths[place]
                if outcome.error is not None and not self.keep_going:
                    raise WorkerError(f"{cell.label}: {outcome.error}")
                if outcome.error is None and path is not None:
                    about = {"cell": asdict(cast(Any, cell)), "seconds": outcome.seconds}
                    write_whole(path, form.write(cast(Result, outcome.result), about))
                outcomes[place] = outcome
                self.progress.advance(cell.label + (" failed" if outcome.error else ""))
        return [outcomes[place] for place in range(len(cells))]

    def clean(self) -> None:
        """Remove results of cells, and their folder if nothing else is in it."""
        if self.folder is not None and self.folder.is_dir():
            for path in self.folder.iterdir():
                if FILE.fullmatch(path.name):
                    path.unlink(missing_ok=True)
            with suppress(OSError):
                self.folder.rmdir()

    def _path(self, cell: Cell, suffix: str) -> Path | None:
        if self.folder is None:
            return None
        values = [type(cell).__name__, asdict(cast(Any, cell)), self.identity(cell)]
        digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
        return self.folder / (digest[:24] + suffix)

    def _each(
        self, places: list[int], task: Callable[[int], Callable[[], tuple[int, Outcome[Result]]]]
    ) -> Iterator[tuple[int, Outcome[Result]]]:
        """Outcomes by place, in the order in which cells end."""
        left = dict.fromkeys(places)
        while left:
            try:
                for place, outcome in run_tasks(map(task, list(left)), self.jobs, self._here):
                    del left[place]
                    yield place, outcome
            except WorkerError:
                from joblib import effective_n_jobs

                suspects = list(left)[: DISPATCHED * effective_n_jobs(self.jobs)]
                for place in suspects:
                    own = task(place)
                    try:
                        (ended,) = run_tasks([own], 2, self._here)
                    except WorkerError as error:
                        ended = place, Outcome(cast(Any, own).args[1], error=str(error))
                    del left[place]
                    yield ended

    @property
    def _here(self) -> bool:
        return self.scheduler is None


def _done(
    place: int, cell: Cell, work: Callable[[], Result], keep_going: bool
) -> tuple[int, Outcome[Result]]:
    began = perf_counter()
    try:
        result = work()
    except (Exception, SystemExit) as error:
        if not keep_going:
            raise
        return place, Outcome(cell, seconds=perf_counter() - began, error=describe(error))
    return place, Outcome(cell, result, perf_counter() - began)


def _kept(path: Path | None, cell: Cell, form: Format[Result]) -> Outcome[Result] | None:
    """Read an earlier run's result of a cell; a damaged one counts as missing."""
    if path is None:
        return None
    try:
        result, about = form.read(path)
        return Outcome(cell, result, about["seconds"])
    except (MirrorError, OSError, ValueError, KeyError, TypeError, AttributeError):
        return None

"""Progress of long work, shown on stderr."""

import sys
from collections.abc import Callable
from contextlib import suppress
from time import monotonic
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self, TextIO

if TYPE_CHECKING:
    from rich.console import Console


Report = Callable[[str, int, int, str], None]
"""Called with the name of long work, steps that are done, all steps, and a message."""


def silent(name: str, done: int, total: int, message: str) -> None:
    """Report nothing."""


class Progress:
    """Shows the progress of long work on stderr; a context manager.

    On a terminal it is a bar with the time elapsed and remaining. Elsewhere (a file, a pipe, a
    notebook) it is plain lines such as `fit: 120/300 loss 12.3, 8 s, 12 s left`: at most one in
    `interval` seconds, and one for the last state when the work ends or fails. It is cheap enough
    to be updated at every step.

    Args:
        name: what is being done, such as "fit".
        total: how many steps there are; None if that is not known.
        done: how many of them were done before, by the run that is resumed.
        interval: seconds between plain lines.
        quiet: show nothing.
        stream: where to, instead of stderr.
    """

    def __init__(
        self,
        name: str,
        total: int | None = None,
        *,
        done: int = 0,
        interval: float = 5.0,
        quiet: bool = False,
        stream: TextIO | None = None,
    ) -> None:
        self.name = name
        self.total = total
        self.done = done
        self.message = ""
        self._interval = interval
        self._quiet = quiet
        self._stream = stream
        self._display: _Display | None = None
        self._shown = (self.done, self.message)
        self._next = 0.0
        self._resume(done)

    def _resume(self, done: int) -> None:
        self._start, self._begun = monotonic(), done
        self._last = self._start

    @property
    def elapsed(self) -> float:
        """Seconds since the work began, or was resumed."""
        return monotonic() - self._start

    @property
    def left(self) -> float | None:
        """Estimated seconds that the rest will take; None while unknown.

        The estimate uses all steps of this run: steps can take minutes, and differ in duration.
        """
        done = self.done - self._begun
        if self.total is None or done < 1:
            return None
        estimate = (self._last - self._start) / done * (self.total - self.done)
        return max(0.0, estimate - (monotonic() - self._last))

    def resume(self, done: int) -> None:
        """Set the steps of an earlier run, which do not enter the estimate of the time left."""
        self._resume(done)
        self.done = done
        if self._display is not None:
            self.message = "done before" if done else ""
            self._shown = (done, self.message)
            self._show()

    def __enter__(self) -> Self:
        self._resume(self.done)
        if not self._quiet:
            # Looked up now, not when the class was defined: stderr may have been redirected since.
            stream = sys.stderr if self._stream is None else self._stream
            display = _bar(self, stream) if stream.isatty() else None
            self._display = display or _Lines(self, stream, self._interval)
            self._next = monotonic() + self._display.interval
        return self

    def _show(self) -> None:
        """Show the progress; work goes on if the stream is closed."""
        assert self._display is not None
        try:
            self._display.show(self)
        except (OSError, ValueError):  # the stream was closed, or its reader went away
            self._display = None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._display is not None:
            if self._shown != (self.done, self.message):
                self._show()
            display, self._display = self._display, None
            if display is not None:
                with suppress(OSError, ValueError):
                    display.close()

    def update(self, done: int, message: str = "") -> None:
        """Report that `done` steps are done in all, with a message such as "loss 12.3"."""
        now = monotonic()
        self.done, self.message, self._last = done, message, now
        if self._display is not None and now >= self._next:
            self._next = now + self._display.interval
            self._shown = (done, message)
            self._show()

    def advance(self, message: str = "") -> None:
        """Report that one more step is done."""
        self.update(self.done + 1, message)


class Reported(Progress):
    """Calls a report instead of showing progress.

    Args:
        name: of the work.
        total: people in all.
        report: called with the number of people who are done.
    """

    def __init__(self, name: str, total: int, report: Report) -> None:
        super().__init__(name, total, quiet=True)
        self._report = report

    def resume(self, done: int) -> None:
        """Set the number of people of an earlier run."""
        super().resume(done)
        self._tell()

    def update(self, done: int, message: str = "") -> None:
        """Report that `done` people are done in all."""
        super().update(done, message)
        self._tell()

    def _tell(self) -> None:
        assert self.total is not None
        self._report(self.name, self.done, self.total, "people")


class Stages:
    """Progress of one stage of work after the other; a context manager."""

    def __init__(self) -> None:
        self.progress: Progress | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        if self.progress is not None:
            self.progress.__exit__(*(error or (None, None, None)))
            self.progress = None

    def report(self, name: str, done: int, total: int, message: str) -> None:
        """Report the progress of a stage; another name ends the stage before it."""
        if self.progress is None or self.progress.name != name:
            self.__exit__(None, None, None)
            self.progress = Progress(name, total).__enter__()
            if done:
                self.progress.resume(done)
        self.progress.update(done, message)


class _Display(Protocol):
    interval: float  # seconds from one `show` to the next, at least

    def show(self, progress: Progress) -> None: ...

    def close(self) -> None: ...


class _Lines:
    """Plain lines, for files, pipes and notebooks."""

    def __init__(self, progress: Progress, stream: TextIO, interval: float) -> None:
        self.interval = interval
        self._stream = stream

    def show(self, progress: Progress) -> None:
        total = "" if progress.total is None else f"/{progress.total}"
        state = f"{progress.name}: {progress.done}{total} {progress.message}".rstrip()
        left = progress.left
        ahead = "" if not left else f", {_duration(left)} left"
        print(f"{state}, {_duration(progress.elapsed)}{ahead}", file=self._stream, flush=True)

    def close(self) -> None:
        pass


class _Bar:
    """A bar of rich, for terminals."""

    interval = 0.1  # rich redraws ten times a second; more frequent updates are wasted

    def __init__(self, progress: Progress, console: "Console") -> None:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            ProgressColumn,
            Task,
            TextColumn,
            TimeElapsedColumn,
        )
        from rich.progress import Progress as RichProgress
        from rich.text import Text

        class Left(ProgressColumn):
            """Time left; rich's own column ignores steps longer than its window."""

            def render(self, task: Task) -> Text:
                left = progress.left
                return Text("" if not left else f"{_duration(left)} left")

        self._rich = RichProgress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            Left(),
            TextColumn("{task.fields[message]}", markup=False),
            console=console,
            # rich sends what is printed meanwhile above the bar, to the bar's stream: right on a
            # terminal, but output that goes to a file must stay in that file.
            redirect_stdout=sys.stdout.isatty(),
        )
        self._task = self._rich.add_task(
            progress.name, total=progress.total, completed=progress.done, message=""
        )
        self._rich.start()

    def show(self, progress: Progress) -> None:
        self._rich.update(self._task, completed=progress.done, message=progress.message)

    def close(self) -> None:
        self._rich.stop()


def _bar(progress: Progress, stream: TextIO) -> _Bar | None:
    """A bar, or None on a terminal that cannot redraw a line."""
    from rich.console import Console

    console = Console(file=stream)
    return None if console.is_dumb_terminal else _Bar(progress, console)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"

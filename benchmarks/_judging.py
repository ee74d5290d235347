"""Cases that are judged in processes of their own, so that one which hangs or dies is one fault.

A case is a number, and judging it gives a verdict. Processes are replaced when they die, and when a
case takes too long.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import resource
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from time import monotonic, process_time
from typing import Any

REFUSED, EQUAL, ANOTHER = "refused", "equal", "another"
GOOD = (REFUSED, EQUAL, ANOTHER)
"""What may become of a case: refused in a line, accepted as it was, or rightly as another."""
SLOW, MOST_MEMORY = 10.0, 500.0
"""Seconds and MB that a case may take."""
PATIENCE, MOST_WORK = 180.0, 15.0
"""Seconds of the clock and of the processor after which a case is ended; making it counts."""
ASKED, MOST_ANYWHERE = re.compile(r"Unable to allocate ([\d.]+) (\w+)"), 200.0
"""What numpy says, and GB beyond which no machine has so much: that is refused at once."""
ROOM = 4 * 2**30
"""Bytes that a process may ask for beyond what it has; more is no memory of this machine's."""


@dataclass(frozen=True)
class Verdict:
    """What became of a case.

    Attributes:
        kind: one of `GOOD`, or a fault.
        signature: what tells this fault from others.
        detail: the message or traceback.
        damage: what was done to the original.
        seconds: that it took.
        megabytes: of memory above what the process had before.
    """

    kind: str
    signature: str = ""
    detail: str = ""
    damage: str = ""
    seconds: float = 0.0
    megabytes: float = 0.0

    @property
    def good(self) -> bool:
        """Whether it is as it should be."""
        return self.kind in GOOD


@dataclass(frozen=True)
class Outcome:
    """What a call gave, or raised, and what it took."""

    value: Any
    error: Exception | None
    seconds: float
    megabytes: float
    noise: str


def measured(call: Callable[[], Any]) -> Outcome:
    """Make a call, and see what it returns or raises, takes, and says on stderr."""
    before = _memory("VmRSS")
    with tempfile.TemporaryFile() as spoken, warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        # As outside of tests, where Python shows these to nobody.
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", PendingDeprecationWarning)
        sys.stderr.flush()
        kept = os.dup(2)
        os.dup2(spoken.fileno(), 2)
        value, error = None, None
        Path("/proc/self/clear_refs").write_text("5")
        # Of the processor, so that other programs do not count; who sleeps meets `PATIENCE`.
        began = process_time()
        try:
            value = call()
        except Exception as raised:  # noqa: BLE001 - whatever it is, it is judged
            error = raised
        seconds = process_time() - began
        most = _memory("VmHWM")
        sys.stderr.flush()
        os.dup2(kept, 2)
        os.close(kept)
        spoken.seek(0)
        said = [spoken.read().decode(errors="replace"), *(str(one.message) for one in warned)]
    return Outcome(value, error, seconds, most - before, " | ".join(filter(None, said)))


def fault_of(outcome: Outcome) -> Verdict | None:
    """The fault of a call, whatever it was for; `None` if it has none of these."""
    from mirror_ppl.errors import MirrorError

    error, took = outcome.error, {"seconds": outcome.seconds, "megabytes": outcome.megabytes}
    if outcome.seconds > SLOW:
        return Verdict("slow", f"{type(error).__name__}", f"{outcome.seconds:.0f} s", **took)
    if outcome.megabytes > MOST_MEMORY or _no_memory(error):
        text = f"{outcome.megabytes:.0f} MB, {error}"
        return Verdict("memory", type(error).__name__, text, **took)
    if error is not None and not isinstance(error, MirrorError):
        text = "".join(traceback.format_exception(error))
        return Verdict("traceback", f"{type(error).__name__} {_place(error)}", text, **took)
    if error is not None and not str(error).isprintable():
        return Verdict("unprintable", type(error).__name__, repr(str(error)), **took)
    if error is not None and not str(error).strip():
        return Verdict("no message", type(error).__name__, **took)
    if outcome.noise:
        return Verdict("noise", outcome.noise[:60], outcome.noise, **took)
    return None


def run_cases(
    work: Callable[[int], Verdict], numbers: Sequence[int], jobs: int
) -> Iterator[tuple[int, Verdict]]:
    """Judge every case, in processes.

    Args:
        work: judges a case; called in other processes, which are copies of this one.
        numbers: of the cases.
        jobs: processes.
    """
    queues = [list(numbers[start::jobs]) for start in range(jobs)]
    workers = {index: _Worker(work, queue) for index, queue in enumerate(queues) if queue}
    while workers:
        wait([worker.pipe for worker in workers.values()], timeout=1.0)
        for index, worker in list(workers.items()):
            yield from worker.verdicts()
            if worker.ended:
                worker.process.join()
                del workers[index]
                if worker.left:
                    workers[index] = _Worker(work, worker.left)


class _Worker:
    """A process, and the cases that it has to judge."""

    def __init__(self, work: Callable[[int], Verdict], left: list[int]) -> None:
        self.left = left
        self.ended = False
        self.pipe, theirs = multiprocessing.Pipe(duplex=False)
        self.process = multiprocessing.get_context("fork").Process(
            target=_judge_all, args=(work, left, theirs), daemon=True
        )
        self.process.start()
        theirs.close()
        self.since, self.worked = monotonic(), 0.0

    def verdicts(self) -> Iterator[tuple[int, Verdict]]:
        """What has come since the last time."""
        try:
            while self.pipe.poll():
                verdict = self.pipe.recv()
                self.since, self.worked = monotonic(), seconds_of(self.process.pid or 0)
                yield self.left.pop(0), verdict
        except EOFError:
            self.process.join()
            self.ended = True
            if self.left:
                status = self.process.exitcode
                yield self.left.pop(0), Verdict("crash", f"status {status}", f"status {status}")
            return
        if self._too_long():
            self.process.kill()
            self.ended = True
            yield self.left.pop(0), Verdict("hang", "no answer", seconds=self._worked())

    def _too_long(self) -> bool:
        return monotonic() - self.since > PATIENCE or self._worked() > MOST_WORK

    def _worked(self) -> float:
        return seconds_of(self.process.pid or 0) - self.worked


def _judge_all(work: Callable[[int], Verdict], numbers: list[int], pipe: Connection) -> None:
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, size + ROOM))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for number in numbers:
        try:
            verdict = work(number)
        except Exception as error:  # noqa: BLE001 - a mistake of these tools, seen in the table
            text = "".join(traceback.format_exception(error))
            verdict = Verdict("mistake", f"{type(error).__name__} {_place(error)}", text)
        pipe.send(verdict)


def seconds_of(process: int) -> float:
    """Seconds of the processor that a process used; 0 if it has ended."""
    try:
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def _memory(which: str) -> float:
    """MB of this process: of now (VmRSS), or the most since it was last reset (VmHWM)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(which):
            return int(line.split()[1]) / 1024
    return 0.0


def _no_memory(error: BaseException | None) -> bool:
    """Whether so much memory was asked for that another machine would have given it."""
    while error is not None:
        asked = ASKED.search(str(error))
        if asked and asked[2][0] in "KMG":
            return asked[2][0] != "G" or float(asked[1]) < MOST_ANYWHERE
        if not asked and (isinstance(error, MemoryError) or "allocate" in str(error).lower()):
            return True
        error = error.__cause__ or error.__context__
    return False


def _place(error: BaseException) -> str:
    """Where in the package an exception came through last, or where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "/mirror_ppl/" in frame.filename]
    frame = (own or frames)[-1]
    return f"{Path(frame.filename).name}:{frame.lineno} {frame.name}"

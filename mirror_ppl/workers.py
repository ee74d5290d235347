"""Tasks that run beside each other in processes, which end with the one that started them."""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

from mirror_ppl.errors import HumanModelError, MirrorError, WorkerError
from mirror_ppl.user_code import describe, passed_user_code, remember_file, remembered_files

Result = TypeVar("Result")

SECONDS_BETWEEN_LOOKS = 1.0
"""How often a worker looks whether the process that started it is still there."""
WATCH = "mirror_ppl watch"
"""Name of the thread that looks."""


def run_tasks(
    tasks: Iterable[Callable[[], Result]], jobs: int, here: bool = True
) -> Iterator[Result]:
    """Do tasks in processes; when this is interrupted or closed, so are they.

    Args:
        tasks: calls without arguments, such as a `functools.partial` of a module's function.
        jobs: number of processes; 1 for this one, -1 for one a core.
        here: whether they are processes of this machine, and not those of joblib's active backend.

    Yields:
        Results, in the order in which tasks end.

    Raises:
        HumanModelError: a task failed in code of a user.
        WorkerError: a process was ended from outside.
    """
    from joblib import Parallel, delayed

    with warnings.catch_warnings():
        # Processes that have used much memory are replaced by new ones; nothing is lost.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs were given")
        own: dict[str, Any] = {}
        if here and jobs != 1:
            own = {"backend": "loky", "initializer": _end_with, "initargs": (os.getpid(),)}
        files = remembered_files()
        calls = (delayed(partial(_guarded, files, task))() for task in tasks)
        results = Parallel(n_jobs=jobs, return_as="generator_unordered", **own)(calls)
        try:
            yield from cast(Iterator[Result], results)
        except BrokenExecutor as error:
            _end_workers()
            raise WorkerError(
                "a worker process was ended from outside, perhaps for lack of memory; use fewer "
                "--jobs"
            ) from error
        except BaseException:
            _end_workers()
            raise


def _guarded(files: Sequence[Path], task: Callable[[], Result]) -> Result:
    for file in files:
        remember_file(file)
    # One thread a process: the cores are shared by processes.
    import torch

    torch.set_num_threads(1)
    try:
        return task()
    except MirrorError:
        raise
    except (Exception, SystemExit) as error:
        if isinstance(error, SystemExit) or passed_user_code(error):
            # In one line, as where it came from is lost on the way to another process.
            raise HumanModelError(describe(error)) from None
        raise


def _end_with(parent: int) -> None:
    """End this process soon after the one that started it, also if that one was killed."""
    with suppress(ValueError):  # not the main thread
        # A terminal interrupts all processes at once; the one that started this one decides.
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(SECONDS_BETWEEN_LOOKS)
        os._exit(1)

    threading.Thread(target=watch, name=WATCH, daemon=True).start()


def _end_workers() -> None:
    from joblib.externals.loky import reusable_executor

    executor: Any = reusable_executor._executor
    if executor is not None:
        executor.shutdown(wait=False, kill_workers=True)

"""Tasks in processes that end with their parent process, or on a cluster."""

from __future__ import annotations

import importlib
import os
import pickle
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

from mirror_ppl.domains import World, added_worlds
from mirror_ppl.domains.registry import know
from mirror_ppl.errors import HumanModelError, MirrorError, OptionError, WorkerError
from mirror_ppl.user_code import describe, passed_user_code, remember_file, remembered_files

Result = TypeVar("Result")

SECONDS_BETWEEN_LOOKS = 1.0
"""Seconds between a worker's checks that its parent process is still there."""
WATCH = "mirror_ppl watch"
"""Name of the thread that checks."""
KILLED = "its process was killed; there may be too little memory for so many --jobs"
"""Message for work whose process was killed."""


def run_tasks(
    tasks: Iterable[Callable[[], Result]], jobs: int, here: bool = True
) -> Iterator[Result]:
    """Run tasks in processes, which end when this is interrupted or closed.

    Args:
        tasks: calls without arguments, such as a `functools.partial` of a module's function.
        jobs: number of processes; 1 for this one, -1 for one per core.
        here: True for processes of this machine, False for those of a `cluster`.

    Yields:
        Results, in the order in which tasks end.

    Raises:
        HumanModelError: a task failed in code of a user.
        WorkerError: a process was killed.
    """
    if here and jobs == 1:
        for task in tasks:  # not by map(), which a StopIteration of a task would end
            yield _guarded(task)
        return
    from joblib import Parallel, delayed

    with warnings.catch_warnings():
        # Processes that have used much memory are replaced by new ones; nothing is lost.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs were given")
        own: dict[str, Any] = {}
        if here:
            own = {"backend": "loky", "initializer": _end_with, "initargs": (os.getpid(),)}
        worlds = added_worlds()
        context = _Context(_files_of_users(), worlds, _environments() if worlds else {})
        each = (partial(_in_worker, context, task) for task in tasks)
        if not here:  # Dask pickles classes of users by name, which its workers do not know
            import cloudpickle

            each = (partial(_called, cloudpickle.dumps(call)) for call in each)
        calls = (delayed(call)() for call in each)
        results = Parallel(n_jobs=jobs, return_as="generator_unordered", **own)(calls)
        try:
            yield from cast(Iterator[Result], results)
        except BaseException as error:
            _end_workers()
            if isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker":
                raise WorkerError(KILLED) from error
            raise


def pickled(thing: object) -> bytes:
    """Pickle what may be of a user's file, which other processes cannot import."""
    import cloudpickle

    _files_of_users()
    return cloudpickle.dumps(thing)


def cluster(address: str) -> ExitStack:
    """Make a context in which tasks that do not run here run on the workers of a Dask scheduler.

    Raises:
        OptionError: Dask is not installed, or the scheduler cannot be reached.
    """
    from joblib import parallel_config

    if not address.strip():
        raise OptionError("--scheduler must be an address, such as tcp://host:8786")
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
            # A client that cannot connect would stay the default client of xarray's locks.
            LoopRunner().run_sync(reach)
            # xarray would ask the default client for locks of files that are written here.
            client = stack.enter_context(Client(address, timeout="10s", set_as_default=False))
        except (OSError, ValueError) as error:
            raise OptionError(f"--scheduler {address} cannot be reached: {error}") from error
        stack.enter_context(parallel_config(backend="dask", client=client))
        return stack.pop_all()


@cache
def _resolved(path: str) -> Path:
    return Path(path).resolve()


def _files_of_users() -> tuple[Path, ...]:
    """Files of users; their classes are pickled by value, as other processes cannot import them."""
    import cloudpickle

    files = remembered_files()
    for module in list(sys.modules.values()) if files else ():
        path = getattr(module, "__file__", None)
        if path is not None and _resolved(path) in files:
            cloudpickle.register_pickle_by_value(module)
    return files


def _environments() -> dict[str, bytes]:
    """Specifications of environments that are registered with Gymnasium, by their ids, pickled.

    Other processes do not run files that register some. What cannot be pickled is left out.
    """
    import cloudpickle

    registration = sys.modules.get("gymnasium.envs.registration")
    found: dict[str, bytes] = {}
    for name, spec in registration.registry.items() if registration else ():
        if not name.startswith("mirror_ppl/"):
            with suppress(Exception):
                found[name] = cloudpickle.dumps(spec)
    return found


def _register(environments: Mapping[str, bytes]) -> None:
    """Register environments as they are in the process that sent them, as far as this one can."""
    if not environments:
        return
    from gymnasium.envs.registration import registry

    for name, content in environments.items():
        with suppress(Exception):  # whoever makes it learns what is missing
            spec = pickle.loads(content)
            if isinstance(spec.entry_point, str):
                # Packages register theirs, and warn where they are registered already.
                importlib.import_module(spec.entry_point.partition(".")[0].partition(":")[0])
            if registry.get(name) != spec:
                registry[name] = spec


@dataclass(frozen=True)
class _Context:
    """What is known in this process and has to be known in others."""

    files: Sequence[Path]
    worlds: Sequence[World]
    environments: Mapping[str, bytes]


def _in_worker(context: _Context, task: Callable[[], Result]) -> Result:
    for file in context.files:
        remember_file(file)
    for world in context.worlds:
        know(world)
    _register(context.environments)
    # One thread a process: the cores are shared by processes.
    import torch

    torch.set_num_threads(1)
    return _guarded(task)


def _called(task: bytes) -> Any:
    """Call a task that was pickled."""
    return pickle.loads(task)()


def _guarded(task: Callable[[], Result]) -> Result:
    try:
        return task()
    except MirrorError:
        raise
    except (Exception, SystemExit) as error:
        if isinstance(error, SystemExit) or passed_user_code(error):
            # In one line, as the traceback is lost on the way to another process.
            raise HumanModelError(describe(error)) from None
        raise


def _end_with(parent: int) -> None:
    """End this process soon after its parent, even if that was killed."""
    with suppress(ValueError):  # not the main thread
        # A terminal interrupts all processes at once; the parent decides.
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

"""Reading netCDF files that may be damaged, and that other software may have written.

The HDF5 library neither ends nor fails on some damaged files, and crashes on others. So another
process tries first.
"""

from __future__ import annotations

import faulthandler
import io
import os
import signal
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from time import monotonic, sleep
from typing import TYPE_CHECKING

from mirror_ppl.errors import MirrorError
from mirror_ppl.files import read_whole

if TYPE_CHECKING:
    import xarray as xr

ENGINES = {b"\x89HDF\r\n\x1a\n": "h5netcdf", b"CDF": "scipy"}
"""First bytes of a file, and the xarray engine that reads it: netCDF-4 is HDF5; netCDF-3 is what
xarray writes where it finds nothing but scipy."""
MOST_COMPRESSED = 1032
"""Bytes that deflate makes of one at most, by its format."""
SMALL = 2**24
"""Bytes that a file may declare however small it is."""
SECONDS, BYTES_PER_SECOND = 3.0, 2**24
"""Time of a processor after which reading counts as endless: for any file, and for so many bytes
more."""
START, SLOW = 20.0, 20.0
"""Seconds that another process may take to start, and how much slower a busy machine may be."""
READ_ALL = """
import io, sys
sys.path[:] = sys.argv[1:]
import h5py
def read(name, part):
    list(part.attrs.items())
    if isinstance(part, h5py.Dataset) and part.size is not None and part.size < 10**8:
        part[()]
with h5py.File(io.BytesIO(sys.stdin.buffer.read())) as file:
    list(file.attrs.items())
    file.visititems(read)
"""
"""A program that reads all of a netCDF-4 file."""


def read_netcdf(
    path: str | os.PathLike[str], failure: type[MirrorError], groups: Iterable[str] = ("/",)
) -> dict[str, xr.Dataset]:
    """Groups of a netCDF file, in memory.

    Args:
        path: the file.
        failure: what to raise.
        groups: their names; those that the file lacks are left out.

    Raises:
        failure: the file is missing, not a netCDF file, or damaged: it cannot be read, reading it
            crashes or does not end, or it declares more than can be in it; one line.
    """
    content = read_whole(path, failure)
    engine = next((name for magic, name in ENGINES.items() if content.startswith(magic)), None)
    if engine is None:
        raise failure(f"{path}: is not a netCDF file")
    if engine == "h5netcdf":
        _import_libraries()
    wanted = tuple(groups)

    def read() -> dict[str, xr.Dataset]:
        return _read(content, engine, wanted)

    if engine == "h5netcdf" and not _ends(read, content):
        raise failure(f"{path}: is truncated or damaged (it cannot be read to its end)")
    try:
        return read()
    # Nearly any exception can come of a damaged file, depending on where the damage is.
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise failure(f"{path}: is truncated or damaged ({reason})") from error


@cache
def _import_libraries() -> None:
    """Here, as other processes would import them time and again."""
    import h5netcdf  # noqa: F401
    from xarray.backends import list_engines

    list_engines()


def _read(content: bytes, engine: str, groups: tuple[str, ...]) -> dict[str, xr.Dataset]:
    import xarray as xr

    if engine == "h5netcdf":
        groups = _checked_groups(content, groups)
    else:  # which has no groups
        groups = tuple(group for group in groups if group == "/")
    found = {}
    with warnings.catch_warnings():
        # What is odd about a file of others, but can be read, is nothing to bother anybody with.
        warnings.simplefilter("ignore")
        for group in groups:
            # From memory, because the libraries leave a damaged file open. Without
            # decode_times=False, units such as "seconds" would turn numbers into dates.
            with xr.open_dataset(
                io.BytesIO(content),
                engine=engine,  # pyright: ignore[reportArgumentType]
                group=None if group == "/" else group,
                decode_times=False,
            ) as dataset:
                found[group] = dataset.load()
    return found


def _checked_groups(content: bytes, groups: tuple[str, ...]) -> tuple[str, ...]:
    """Those of the groups that are there, if the file declares no more than can be in it."""
    import h5py

    declared = 0

    def add(name: str, part: object) -> None:
        nonlocal declared
        if isinstance(part, h5py.Dataset):
            declared += part.size * part.dtype.itemsize if part.size else 0

    with h5py.File(io.BytesIO(content)) as file:
        # h5netcdf would write to stderr if it failed to read these.
        list(file.attrs.items())
        file.visititems(add)
        if declared > MOST_COMPRESSED * len(content) + SMALL:
            raise ValueError(f"it declares {declared:,} bytes, but has {len(content):,}")
        return tuple(group for group in groups if isinstance(file.get(group), h5py.Group))


def _ends(read: Callable[[], object], content: bytes) -> bool:
    """Whether reading comes to an end, with a result or an exception, in another process."""
    seconds = SECONDS + len(content) / BYTES_PER_SECOND
    if hasattr(os, "fork") and threading.active_count() == 1:
        return _forked(read, seconds)
    # A copy of a process with threads may wait for ever for what another thread holds. A new one
    # takes longer to start.
    try:
        command = [sys.executable, "-c", READ_ALL, *sys.path]
        done = subprocess.run(
            command, input=content, capture_output=True, timeout=START + SLOW * seconds, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode >= 0


def _forked(read: Callable[[], object], seconds: float) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads that are not Python's
        child = os.fork()
    if not child:
        _try(read, seconds)
    try:
        deadline, pause = monotonic() + START + SLOW * seconds, 0.001
        while monotonic() < deadline:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return os.WIFEXITED(status)
            sleep(pause)
            pause = min(2 * pause, 0.05)
    except BaseException:
        _end(child)
        raise
    _end(child)
    return False


def _end(child: int) -> None:
    with suppress(OSError):
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def _try(read: Callable[[], object], seconds: float) -> None:
    """Read, and end this process."""
    try:
        faulthandler.disable()
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        # Of the processor's time, so that a busy machine makes no difference.
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, seconds)
        read()
    finally:
        os._exit(0)

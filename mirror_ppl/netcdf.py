"""Reading of netCDF files that may be damaged, and that other software may have written.

The HDF5 library hangs on some damaged files, and crashes on others, so another process reads them
first.
"""

from __future__ import annotations

import faulthandler
import hashlib
import io
import math
import os
import select
import signal
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from typing import TYPE_CHECKING

from mirror_ppl.errors import MirrorError
from mirror_ppl.files import read_whole
from mirror_ppl.workers import WATCH

if TYPE_CHECKING:
    import xarray as xr

ENGINES = {b"\x89HDF\r\n\x1a\n": "h5netcdf", b"CDF": "scipy"}
"""First bytes of a file, and the xarray engine that reads it: netCDF-4 is HDF5; netCDF-3 is what
xarray writes where it finds nothing but scipy."""
MOST_COMPRESSED = 1032
"""Most bytes that deflate can make of one, by its format."""
SMALL = 2**24
"""Bytes that any file may declare, however small."""
SECONDS, BYTES_PER_SECOND = 3.0, 2**26
"""Processor time after which reading counts as endless: seconds for any file, and declared bytes
for each second more."""
IMPORTS = 2.0
"""Processor seconds that a new process needs to import its libraries."""
START, SLOW = 20.0, 20.0
"""Seconds that another process may take to start, and allowed slowdown of a busy machine."""
_READ: set[tuple[bytes, tuple[str, ...]]] = set()
"""Hashes of contents, and their groups, that another process could read already."""
_MADE: set[bytes] = set()
"""Hashes of contents that this process made."""
READ_ALL = """
import io, resource, sys
most, seconds = int(sys.argv[1]), int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
sys.path[:] = sys.argv[3:]
import h5py
parts = []
with h5py.File(io.BytesIO(sys.stdin.buffer.read())) as file:
    list(file.attrs.items())
    file.visititems(lambda name, part: parts.append(part))
    data = [part for part in parts if isinstance(part, h5py.Dataset) and part.size]
    if sum(part.size * part.dtype.itemsize for part in data) <= most:
        for part in parts:
            list(part.attrs.items())
        for part in data:
            part[()]
"""
"""A program that reads all of a netCDF-4 file, if it declares at most a given number of bytes."""


def read_netcdf(
    path: str | os.PathLike[str], failure: type[MirrorError], groups: Iterable[str] = ("/",)
) -> dict[str, xr.Dataset]:
    """Read groups of a netCDF file into memory.

    Args:
        path: the file.
        failure: class of the exception to raise.
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

    def read(allow: Callable[[int], object] = lambda declared: None) -> dict[str, xr.Dataset]:
        return _read(content, engine, wanted, allow)

    key = hashlib.sha256(content).digest(), wanted
    if engine == "h5netcdf" and key[0] not in _MADE and key not in _READ:
        if not _ends(read, content):
            raise failure(f"{path}: is truncated or damaged (it cannot be read to its end)")
        _READ.add(key)
    try:
        return read()
    # Nearly any exception can come of a damaged file, depending on where the damage is.
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise failure(f"{path}: is truncated or damaged ({reason})") from error


def made(content: memoryview) -> memoryview:
    """Remember content that this process made, so that no other process reads it first."""
    _MADE.add(hashlib.sha256(content).digest())
    return content


@cache
def _import_libraries() -> None:
    """Import libraries in this process, or each other process would import them again."""
    import h5netcdf  # noqa: F401

    with suppress(ImportError):  # which xarray imports where it is installed
        import dask.array  # noqa: F401 # pyright: ignore[reportMissingImports]


def _read(
    content: bytes, engine: str, groups: tuple[str, ...], allow: Callable[[int], object]
) -> dict[str, xr.Dataset]:
    """Read the groups; `allow` is called before with the bytes that the file declares."""
    import xarray as xr

    if engine == "h5netcdf":
        groups, declared = _checked_groups(content, groups)
        allow(declared)
    else:  # which has no groups
        groups = tuple(group for group in groups if group == "/")
    # From memory, because the libraries leave a damaged file open.
    file, found = io.BytesIO(content), {}
    with warnings.catch_warnings():
        # For oddities in a file that can still be read.
        warnings.simplefilter("ignore")
        if engine == "h5netcdf":
            found = _undecoded(file, groups)
        elif groups:
            with xr.open_dataset(file, engine="scipy", decode_cf=False) as dataset:
                found = {"/": dataset.load()}
        # Without decode_times=False, units such as "seconds" would turn numbers into dates.
        return {
            group: xr.decode_cf(dataset, decode_times=False).load()
            for group, dataset in found.items()
        }


def _undecoded(file: io.BytesIO, groups: Iterable[str]) -> dict[str, xr.Dataset]:
    """Groups of a netCDF-4 file as they are stored.

    ``xarray.open_dataset`` would take two to three times as long, most of it to find out how
    variables are packed.
    """
    import h5netcdf
    import h5py
    import numpy as np
    import xarray as xr

    with h5netcdf.File(file, "r", decode_vlen_strings=True) as whole:
        found = {}
        for name in groups:
            group = whole if name == "/" else whole[name]
            variables = {}
            for own, variable in group.variables.items():
                values = variable[...]
                if h5py.check_dtype(vlen=variable.dtype) is str:
                    values = np.asarray(values, dtype=str)  # else objects
                variables[own] = xr.Variable(variable.dimensions, values, dict(variable.attrs))
            found[name] = xr.Dataset(variables, attrs=dict(group.attrs))
        return found


def _checked_groups(content: bytes, groups: tuple[str, ...]) -> tuple[tuple[str, ...], int]:
    """Return the groups that exist, and the bytes that the file declares.

    Raises:
        ValueError: it declares more than can be in it.
    """
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
        if declared > _most(content):
            raise ValueError(f"it declares {declared:,} bytes, but has {len(content):,}")
        there = tuple(group for group in groups if isinstance(file.get(group), h5py.Group))
        return there, declared


def _most(content: bytes) -> int:
    """Bytes that a file may declare."""
    return MOST_COMPRESSED * len(content) + SMALL


def _ends(read: Callable[[Callable[[int], object]], object], content: bytes) -> bool:
    """True if reading ends in another process, with a result or an exception."""
    most = START + SLOW * (SECONDS + _most(content) / BYTES_PER_SECOND)
    others = {thread.name for thread in threading.enumerate()} - {"MainThread", WATCH}
    if hasattr(os, "fork") and not others:
        return _forked(read, most)
    # A fork of a process with threads may wait forever for a lock of another thread. A new process
    # takes longer to start.
    limit = math.ceil(IMPORTS + SECONDS + _most(content) / BYTES_PER_SECOND)
    command = [sys.executable, "-c", READ_ALL, str(_most(content)), str(limit), *sys.path]
    try:
        done = subprocess.run(
            command, input=content, capture_output=True, timeout=most, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    except OSError:  # there is no Python executable
        return True
    return done.returncode >= 0


def _forked(read: Callable[[Callable[[int], object]], object], seconds: float) -> bool:
    ended, end = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads that are not Python's
        child = os.fork()
    if not child:
        _try(read, end)
    os.close(end)
    try:
        # The child says so when it has read; the pipe closes when it ends, however it ends.
        ready, _, _ = select.select([ended], [], [], seconds)
        return bool(ready) and os.read(ended, 1) != b""
    finally:
        os.close(ended)
        with suppress(OSError):
            os.kill(child, signal.SIGKILL)
        with suppress(OSError):  # where children are reaped by others
            os.waitpid(child, 0)


def _try(read: Callable[[Callable[[int], object]], object], end: int) -> None:
    """Read, say so, and end this process."""

    def allow(declared: int) -> None:
        signal.setitimer(signal.ITIMER_PROF, SECONDS + declared / BYTES_PER_SECOND)

    try:
        faulthandler.disable()
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        # Processor time, so that a busy machine makes no difference.
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        with suppress(BaseException):
            read(allow)
        os.write(end, b"1")
    finally:
        os._exit(0)

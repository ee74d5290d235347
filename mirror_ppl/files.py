"""Atomic writing of files, and reading of whole files."""

import errno
import json
import os
import secrets
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from math import isfinite
from pathlib import Path
from platform import node
from typing import Any, BinaryIO

from mirror_ppl.errors import MirrorError, OutputError
from mirror_ppl.limits import free_memory

try:
    import fcntl
except ImportError:  # not a POSIX system: files are written whole there, but not locked
    fcntl = None

PARTIAL = ".partial"
"""Suffix of files that are being written."""
LOCK = ".lock"
"""Name of the file that a process locks while it alone writes in a folder."""


Content = bytes | memoryview | str


def write_whole(path: str | os.PathLike[str], content: Content) -> Path:
    """Write a file atomically: readers see its old content or all of the new, never a part.

    Args:
        path: the file to write; a link is followed.
        content: all of it; text is written as UTF-8.

    Returns:
        `path`.

    Raises:
        OutputError: the folder cannot be created, or the file cannot be written.
    """
    write_together({path: content})
    return Path(path)


def write_together(
    contents: Mapping[str | os.PathLike[str], Content] | Mapping[Path, Content],
    remove: Iterable[Path] = (),
) -> None:
    """Write several files atomically, all of them or none.

    Temporary files in the same folders are written, and then renamed. Folders that are missing are
    created. On any failure, interruption included, old files are as before and nothing new is left
    behind. A process that is killed during the renaming may leave some of the new files, each
    complete; temporary files that it leaves are removed by the next `output_folder`.

    Content is made in memory first: libraries that write files themselves report a full disk in
    many ways, one of which is to crash.

    Args:
        contents: complete content of each file; links are followed, text becomes UTF-8.
        remove: older files that are out of date when these are written.

    Raises:
        OutputError: a folder cannot be created, or a file cannot be written.
    """
    ready: list[tuple[Path, BinaryIO, Path]] = []
    made: list[Path] = []
    old: dict[Path, Path] = {}
    placed: list[Path] = []
    path: str | os.PathLike[str] = ""
    try:
        for path, content in contents.items():
            # The temporary file must lie where the file itself does: a rename cannot cross file
            # systems.
            target = Path(os.path.realpath(path))
            _require_file(target, path)
            _make_folder(target.parent, made)
            temporary, file = _locked_temporary(target)
            ready.append((temporary, file, target))
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        stale = [Path(os.path.realpath(file)) for file in remove]
        for target in {*stale, *(target for _, _, target in ready)}:
            with suppress(OSError):  # there is none, or the file system has no links
                backup = _temporary_beside(target)
                os.link(target, backup)
                old[target] = backup
        for path in stale:
            path.unlink(missing_ok=True)
        for temporary, _, target in ready:
            path = target
            placed.append(target)
            temporary.replace(target)
    except BaseException as error:
        for target in placed:
            if target not in old:
                with suppress(OSError):
                    target.unlink(missing_ok=True)
        for target, backup in old.items():
            with suppress(OSError):
                backup.replace(target)
        for temporary, _, _ in ready:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
        _remove_folders(made)
        if isinstance(error, OSError | ValueError):  # a ValueError of a name or text that cannot be
            raise OutputError(f"cannot write {path}: {_reason(error)}") from error
        raise
    finally:
        for backup in old.values():
            with suppress(OSError):
                backup.unlink(missing_ok=True)
        for _, file, _ in ready:
            with suppress(OSError):
                file.close()


def read_whole(path: str | os.PathLike[str], failure: type[MirrorError]) -> bytes:
    """Read the whole content of a regular file.

    Pipes and devices are refused: reading them may never end.

    Raises:
        failure: the file is missing, cannot be read, is not a regular file, or is too large.
    """
    try:
        found = os.stat(path)
        if not stat.S_ISREG(found.st_mode):
            raise failure(f"{path}: is not a regular file")
        free = free_memory()
        if free is not None and found.st_size > free / 2:
            raise failure(f"{path}: its {found.st_size:,} bytes do not fit into memory")
        return Path(path).read_bytes()
    except MemoryError as error:
        raise failure(f"{path}: does not fit into memory") from error
    except FileNotFoundError as error:
        raise failure(f"{path}: there is no such file") from error
    except (OSError, ValueError) as error:  # a ValueError of a path with a null character
        raise failure(f"{path}: cannot be read ({error})") from error


def json_text(content: Any) -> str:
    """Strict JSON of plain values, paths and dataclasses; numbers that are not finite are null."""
    return json.dumps(plain(content), indent=1, allow_nan=False) + "\n"


def plain(content: Any) -> Any:
    """Convert numpy's numbers and arrays, paths and dataclasses to values of strict JSON."""
    if hasattr(content, "tolist"):  # of numpy or torch
        content = content.tolist()
    if isinstance(content, float):
        return content if isfinite(content) else None
    if isinstance(content, Path):
        return str(content)
    if is_dataclass(content) and not isinstance(content, type):
        content = asdict(content)
    if isinstance(content, Mapping):
        return {str(key): plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [plain(value) for value in content]
    return content


@contextmanager
def output_folder(
    path: str | os.PathLike[str],
    names: Iterable[str] = (),
    lock: str = LOCK,
    parts: Sequence[str] = (),
) -> Iterator[Path]:
    """Lock a folder in which this process alone writes its results; a context around long work.

    It is created where it is missing, and removed again if the work fails before anything is in it.
    Results that cannot be written are detected first. Temporary files of killed processes are
    removed. The lock is a file that names its process; the operating system releases it when that
    process ends, however it ends.

    Args:
        path: the folder.
        names: of the files that will be written in it.
        lock: name of the lock; another than the folder's where several commands write their results
            in one folder, see `lock_of`.
        parts: names of folders in it that will hold parts of the results.

    Yields:
        The folder.

    Raises:
        OutputError: it cannot be created or written, something that is not a regular file has the
            name of a result, or another process, named in the message, writes these results.
            Nothing is left behind.
    """
    folder = Path(path)
    for name in names:
        _require_file(folder / name, folder / name)
    for part in parts:
        if os.path.lexists(folder / part) and not os.path.isdir(folder / part):
            raise OutputError(f"cannot create the folder {folder / part}: there is a file")
    made: list[Path] = []
    try:
        _make_folder(folder, made)
        for part in ("", *parts):
            _remove_abandoned(folder / part)
        with _sole_use(folder / lock):
            yield folder
    except BaseException:
        _remove_folders(made)
        raise


def lock_of(path: Path) -> str:
    """Name of the lock of a file that is written at the end of long work."""
    return f".{_short(path.name)}{LOCK}"


@contextmanager
def _sole_use(path: Path) -> Iterator[None]:
    try:
        file = _held(path)
    except OSError as error:
        raise OutputError(f"cannot write in {path.parent}: {_reason(error)}") from error
    if file is None:
        holder = ""
        with suppress(OSError):
            holder = path.read_text(errors="replace").strip()
        own = path.name[1 : -len(LOCK)]
        raise OutputError(
            f"{path.with_name(own) if own else path.parent} is being written by "
            f"{holder or 'another process'}; wait until it ends, or write elsewhere"
        )
    with file:
        try:
            yield
        finally:
            with suppress(OSError):
                path.unlink(missing_ok=True)


def require_files_of_their_own(
    outputs: Mapping[str, Path | None], inputs: Mapping[str, Sequence[Path | None]]
) -> list[Path]:
    """Check that files to write are regular files, and named by no other option.

    Args:
        outputs: files to write, by the option that names them; ``None`` where none does.
        inputs: files to read, by what names them.

    Returns:
        The files to write.

    Raises:
        OutputError: one is named twice, or is there and is not a regular file.
    """
    taken = {
        os.path.realpath(path): option for option, paths in inputs.items() for path in paths if path
    }
    result = []
    for option, path in outputs.items():
        if path is None:
            continue
        real = os.path.realpath(path)
        if real in taken:
            raise OutputError(f"cannot write {path}: it is what {taken[real]} names")
        _require_file(path, path)
        taken[real] = option
        result.append(path)
    return result


def _require_file(target: Path, named: str | os.PathLike[str]) -> None:
    try:
        mode = os.stat(target).st_mode
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        # A file in the place of a folder is reported when the folder is made.
        if isinstance(error, NotADirectoryError):
            return
        raise OutputError(f"cannot write {named}: {_reason(error)}") from error
    if not stat.S_ISREG(mode):
        # As root, a rename would replace even a device such as /dev/null.
        raise OutputError(f"cannot write {named}: it is not a regular file")


def _temporary_beside(target: Path) -> Path:
    return target.with_name(f".{_short(target.stem)}-{secrets.token_hex(8)}{PARTIAL}")


def _short(name: str) -> str:
    """The beginning of a name: with something added, a long but valid one stays valid."""
    return os.fsencode(name)[:100].decode(errors="ignore")


def _locked_temporary(target: Path) -> tuple[Path, BinaryIO]:
    """Make a file that is locked while it is open, so that no process counts it as abandoned."""
    while True:
        path = _temporary_beside(target)
        # Created here, not by tempfile, so that it gets the permissions of any other new file.
        file = path.open("xb")
        if _lock(file) is not False and os.fstat(file.fileno()).st_nlink:
            return path, file
        file.close()  # another process removed it before it was locked


def _remove_abandoned(folder: Path) -> None:
    for path in folder.glob(f".*{PARTIAL}"):
        with suppress(OSError), path.open("r+b") as file:
            if _lock(file):
                path.unlink()


def _lock(file: BinaryIO) -> bool | None:
    """True if this process now holds the file's lock; None where there are no locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
            raise
        return None
    return True


def _held(path: Path) -> BinaryIO | None:
    """Open and lock a file; None where another process holds it."""
    while True:
        file = path.open("a+b")
        try:
            if _lock(file) is False:
                file.close()
                return None
            # The process that held it before may have removed it in between.
            if os.fstat(file.fileno()).st_nlink:
                file.truncate(0)
                file.write(f"process {os.getpid()} on {node()}\n".encode())
                file.flush()
                return file
        except BaseException:
            file.close()
            with suppress(OSError):
                path.unlink()
            raise
        file.close()


def _make_folder(folder: Path, made: list[Path]) -> None:
    """Create the folder and its parents; adds those that were missing, outermost first."""
    try:
        for step in (*reversed(folder.parents), folder):
            if step.is_dir():
                continue
            made.append(step)  # before it is there, so that no interruption leaves it behind
            try:
                step.mkdir()
            except FileExistsError:
                made.remove(step)
                # Fine if another process was quicker, but not if there is a file in the way.
                if not step.is_dir():
                    code = errno.ENOTDIR
                    raise NotADirectoryError(code, os.strerror(code), str(step)) from None
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot create the folder {folder}: {_reason(error)}") from error


def _remove_folders(made: list[Path]) -> None:
    for folder in reversed(made):
        # Not empty any more: another process uses it by now. Or it could not be created.
        with suppress(OSError, ValueError):
            folder.rmdir()


def _reason(error: OSError | ValueError) -> str:
    if not isinstance(error, OSError) or error.strerror is None:
        return str(error)
    return f"{error.strerror}: {error.filename}" if error.filename else error.strerror

"""Files that are written whole or not at all."""

import errno
import os
import secrets
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mirror_ppl.errors import CheckpointError, OutputError


def write_whole(path: str | os.PathLike[str], writer: Callable[[Path], object]) -> Path:
    """Write a file such that readers see its old content or all of the new, never a part.

    The writer fills a temporary file in the same folder, which then takes the file's place. Folders
    that are missing are created. On any failure, interruption included, the old file is untouched
    and nothing new is left behind.

    Args:
        path: the file to write; a link is followed.
        writer: is given the temporary file's path, which ends in the same suffix as `path`, and
            writes there. It should do nothing else: each `OSError` of it counts as a failure to
            write.

    Returns:
        `path`.

    Raises:
        OutputError: the folder cannot be created, or the file cannot be written.
    """
    # The temporary file must lie where the file itself does: a rename cannot cross file systems.
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        # As root, a rename would replace even a device such as /dev/null.
        raise OutputError(f"cannot write {path}: it is not a regular file")
    made = _make_folder(target.parent)
    temporary = _temporary_beside(target)
    try:
        # Created here, not by tempfile, so that it gets the permissions of any other new file.
        temporary.touch(exist_ok=False)
        writer(temporary)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        _remove_folders(made)
        if isinstance(error, OSError):
            raise OutputError(f"cannot write {path}: {_reason(error)}") from error
        raise
    return Path(path)


def prepare_output_folder(path: str | os.PathLike[str]) -> Path:
    """Create a folder where it is missing, and make sure that files can be written in it.

    Called before long work, so that a folder that cannot be written is found out first.

    Returns:
        The folder.

    Raises:
        OutputError: it cannot be created or written; nothing is left behind.
    """
    folder = Path(path)
    made = _make_folder(folder)
    probe = _temporary_beside(folder / "probe")
    try:
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        _remove_folders(made)
        raise OutputError(f"cannot write in the folder {folder}: {_reason(error)}") from error
    return folder


def read_checkpoint(path: Path, run: Any) -> dict[str, Any]:
    """What a checkpoint of a run holds, written by ``torch.save`` with the run under ``"run"``.

    Raises:
        CheckpointError: the file is damaged or of another run.
    """
    import torch

    try:
        content = torch.load(path, weights_only=True)
        own = content["run"]
    except Exception as error:
        raise CheckpointError(f"{path} is not a checkpoint of this program; remove it") from error
    if own != run:
        raise CheckpointError(
            f"{path} belongs to a run with other options, seed or recordings; remove it, or "
            "write elsewhere"
        )
    return content


def require_files_of_their_own(
    outputs: Mapping[str, Path | None], inputs: Mapping[str, Sequence[Path | None]]
) -> list[Path]:
    """Make sure that files to write are neither something else that was named nor folders.

    Args:
        outputs: files to write, by the option that names them; ``None`` where none does.
        inputs: files to read, by what names them.

    Returns:
        The files to write.

    Raises:
        OutputError: one is named twice, or is there and is not a regular file.
    """
    taken = {path.resolve(): option for option, paths in inputs.items() for path in paths if path}
    result = []
    for option, path in outputs.items():
        if path is None:
            continue
        if path.resolve() in taken:
            raise OutputError(f"cannot write {path}: it is what {taken[path.resolve()]} names")
        if path.exists() and not path.is_file():
            raise OutputError(f"cannot write {path}: it is not a regular file")
        taken[path.resolve()] = option
        result.append(path)
    return result


def _temporary_beside(target: Path) -> Path:
    # Some writers choose the format by the suffix, or add one where it is missing. The target's
    # name is cut so that a long but valid one stays valid.
    return target.with_name(f".{target.stem[:100]}-{secrets.token_hex(8)}{target.suffix}")


def _make_folder(folder: Path) -> list[Path]:
    """Create the folder and its parents; returns those that were missing, outermost first."""
    made: list[Path] = []
    try:
        for step in (*reversed(folder.parents), folder):
            if step.is_dir():
                continue
            try:
                step.mkdir()
            except FileExistsError:
                # Fine if another process was quicker, but not if there is a file in the way.
                if not step.is_dir():
                    code = errno.ENOTDIR
                    raise NotADirectoryError(code, os.strerror(code), str(step)) from None
            else:
                made.append(step)
    except OSError as error:
        _remove_folders(made)
        raise OutputError(f"cannot create the folder {folder}: {_reason(error)}") from error
    return made


def _remove_folders(made: list[Path]) -> None:
    for folder in reversed(made):
        # Not empty any more: somebody else uses it by now.
        with suppress(OSError):
            folder.rmdir()


def _reason(error: OSError) -> str:
    if error.strerror is None:
        return str(error)
    return f"{error.strerror}: {error.filename}" if error.filename else error.strerror

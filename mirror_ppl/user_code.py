"""Code of users: files that commands load and run, and faults in them described in one line."""

from __future__ import annotations

import traceback
from pathlib import Path

_FILES: set[Path] = set()


def remember_file(path: Path) -> None:
    """Count a file among those of users from now on."""
    _FILES.add(path.resolve())


def remembered_files() -> tuple[Path, ...]:
    """Files of users, for other processes to remember."""
    return tuple(_FILES)


def describe(error: BaseException, path: Path | None = None) -> str:
    """An exception in one line, with the last line of the user's own file that it passed.

    Args:
        error: the exception.
        path: the file; any that was remembered unless given.
    """
    if isinstance(error, SyntaxError) and error.filename:
        return f"SyntaxError: {error.msg} ({Path(error.filename).name}, line {error.lineno})"
    frames = traceback.extract_tb(error.__traceback__)
    own = _own_frames(frames, _FILES if path is None else {path.resolve()})
    text = " ".join(str(error).split())
    if isinstance(error, SystemExit):
        text = f"the file ends the program, sys.exit({text})"
    else:
        text = f"{type(error).__name__}: {text}" if text else type(error).__name__
    if not frames:
        return text
    line = (own or frames)[-1]
    return f"{text} ({Path(line.filename).name}, line {line.lineno})"


def passed_user_code(error: BaseException) -> bool:
    """Whether an exception was raised in, or came through, a file of a user."""
    return bool(_own_frames(traceback.extract_tb(error.__traceback__), _FILES))


def _own_frames(frames: traceback.StackSummary, files: set[Path]) -> list[traceback.FrameSummary]:
    return [frame for frame in frames if Path(frame.filename).resolve() in files]

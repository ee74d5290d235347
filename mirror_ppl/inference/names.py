"""Former names of engines; imports nothing heavy, so that commands can check them first."""

from __future__ import annotations

import sys

FORMER = {"exact": "importance"}


def current_name(name: str) -> tuple[str, str | None]:
    """Current name of an engine, and a note if the given name is a former one."""
    if not isinstance(name, str) or name not in FORMER:
        return name, None
    new = FORMER[name]
    return new, f'"{name}" is called "{new}" now; version 0.3 no longer knows the old name'


def told_engine(name: str) -> str:
    """Current name of the engine of ``--guide``; prints a note to stderr for a former name."""
    name, note = current_name(name)
    if note is not None:
        print(f"--guide: {note}", file=sys.stderr)
    return name

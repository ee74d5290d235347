"""Names that engines had in earlier versions; light, for commands to look up before they import."""

from __future__ import annotations

import sys

FORMER = {"exact": "importance"}


def current_name(name: str) -> tuple[str, str | None]:
    """An engine's name now, and a note if it was given as in earlier versions."""
    if not isinstance(name, str) or name not in FORMER:
        return name, None
    new = FORMER[name]
    return new, f'"{name}" is called "{new}" now; version 0.3 no longer knows the old name'


def told_engine(name: str) -> str:
    """The name now of the engine of ``--guide``; a former one is told on stderr."""
    name, note = current_name(name)
    if note is not None:
        print(f"--guide: {note}", file=sys.stderr)
    return name

"""Names that engines had in earlier versions; light, for commands to look up before they import."""

from __future__ import annotations

FORMER = {"exact": "importance"}


def current_name(name: str) -> tuple[str, str | None]:
    """An engine's name now, and a note if it was given as in earlier versions."""
    if not isinstance(name, str) or name not in FORMER:
        return name, None
    new = FORMER[name]
    return new, f'"{name}" is called "{new}" now; version 0.3 no longer knows the old name'

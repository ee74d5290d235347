"""Exceptions of this project, for errors that its user can correct.

A command turns each of them into one line on stderr and exit status 2 (see `mirror_ppl.console`).
Errors of the code itself stay `ValueError`, `TypeError` and so on. Messages say what was expected
and what was given, in one printable line (see `shown`).
"""

import re
from collections.abc import Iterable
from difflib import get_close_matches
from reprlib import repr as short_repr
from typing import Any, Self

MOST_CHARACTERS = 100
"""Most characters of a name that a user chooses, such as a person's id."""
NUMBER = re.compile(r"[0-9]+")
SHOWN = 40
"""Characters of a longer text that a message shows."""


def shown(value: Any) -> str:
    """Format a value for a message: short, printable, on one line.

    A long text is cut, an array is shown by its shape, other objects by their class.
    """
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple):
        if shape:
            return f"{type(value).__name__} of shape {tuple(shape)}"
        value = value.item()
    if isinstance(value, str):
        return repr(value) if len(value) <= SHOWN else f"{value[:SHOWN]!r}..."
    if value is None or isinstance(value, bool | int | float | complex | slice):
        return short_repr(value)
    if isinstance(value, list | tuple) and all(isinstance(one, str | int | float) for one in value):
        return short_repr(value)
    return value.__name__ if isinstance(value, type) else type(value).__name__


def is_name(value: object) -> bool:
    """True if a value can be a name: printable text of at most 100 characters, not empty.

    Spaces at its ends are not allowed, as they are invisible.
    """
    if not isinstance(value, str) or value.strip() != value:
        return False
    return value.isprintable() and 0 < len(value) <= MOST_CHARACTERS


class MirrorError(Exception):
    """Parent of all the project's exceptions; raised only through its children."""


class InputError(MirrorError, ValueError):
    """Raised for an argument of a wrong kind, shape or value.

    It is a `ValueError` besides, as Python's own functions raise it for such arguments.
    """


class DemonstrationsError(MirrorError):
    """Raised for recorded rounds that cannot be used.

    A file that is missing or not in the demonstrations' format, arrays whose lengths or values
    contradict each other, people or rounds that were asked for and are not there.
    """


class DomainError(MirrorError):
    """Raised for a world that cannot be loaded or breaks its contract."""


class HumanModelError(MirrorError):
    """Raised for a human model that cannot be loaded or breaks its contract.

    A file or class that is not there, a method with the wrong arguments, a method whose result has
    the wrong shape.
    """


class RuledOutError(HumanModelError):
    """Raised if a human model rules out all draws of a person's implants."""


class UnknownNameError(MirrorError):
    """Raised for a name, of a domain, a setting, an item and so on, that is not a known one."""

    # A constructor with other arguments than the message could not be unpickled, and so would break
    # the report of an error that a worker process raised.
    @classmethod
    def of(cls, kind: str, name: str, known: Iterable[str], where: str = "") -> Self:
        """Make the exception; its message lists the known names and the closest one.

        Args:
            kind: what the name stands for, such as "domain".
            name: the name that was given.
            known: the names that would have been right.
            where: the domain, if names differ between domains.
        """
        names = sorted(known)
        place = f" in {where}" if where else ""
        own = f'"{name}"' if is_name(name) else shown(name)
        message = f"unknown {kind} {own}{place}; known: {', '.join(names) or 'none'}"
        if not isinstance(name, str):
            return cls(message)
        lowered = {candidate.lower(): candidate for candidate in names}
        mine = name.lower()
        for close in get_close_matches(mine, lowered, n=1):
            # Of names that differ in their numbers only, none is closer.
            if close == mine or NUMBER.sub("", close) != NUMBER.sub("", mine):
                message += f'; perhaps you meant "{lowered[close]}"'
        return cls(message)


class PosteriorError(MirrorError):
    """Raised for a posterior file that cannot be used.

    It is missing or damaged, holds no draws, or is of another domain, model or version.
    """


class OptionError(MirrorError):
    """Raised for an option of a command whose value makes no sense."""


class AssetError(MirrorError):
    """Raised for a trained network that ships, or was saved, and cannot be used.

    It is missing, damaged, or was made for another domain or by an incompatible version.
    """


class OtherPriorError(AssetError):
    """Raised for a network that was trained with another prior."""


class OutputError(MirrorError):
    """Raised for a file or folder that cannot be created or written."""


class WorkerError(MirrorError):
    """Raised if a worker process was killed."""


class CheckpointError(MirrorError):
    """Raised for a checkpoint from which work cannot be resumed.

    It is damaged, or it belongs to a run with other options.
    """


class MirrorWarning(UserWarning):
    """Base class of the package's warnings; commands print them in one line."""


class StaleSelfModel(MirrorWarning):
    """Warns that a user's world has changed since its self-model was trained."""


class LacksSitesOfWorld(MirrorWarning):
    """Warns that a human model is not derived from the one that its world needs."""


class MisspeltMember(MirrorWarning):
    """Warns that a method of a user's class overrides none, but almost has the name of one."""


class UnreadSite(MirrorWarning):
    """Warns that nothing in a user's human model seems to depend on some sites of its prior."""


class UnexplainedPerson(MirrorWarning):
    """Warns that messages are for a person whose actions the human model does not explain."""


class PriorConflict(MirrorWarning):
    """Warns that a prior is at odds with most of the people."""


class UnreliableWeights(MirrorWarning):
    """Warns that a person's importance weights are not reliable."""

"""The exceptions that this project raises for what its user can put right.

A command turns each of them into one line on stderr and exit status 2 (see `mirror_ppl.console`).
Mistakes of the code itself stay what they are: `ValueError`, `TypeError` and so on.
"""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Self


class MirrorError(Exception):
    """Parent of all the project's exceptions; raised only through its children."""


class DemonstrationsError(MirrorError):
    """Raised for recorded rounds that cannot be used.

    A file that is missing or not in the demonstrations' format, arrays whose lengths or values
    contradict each other, people or rounds that were asked for and are not there.
    """


class HumanModelError(MirrorError):
    """Raised for a human model that cannot be loaded or breaks its contract.

    A file or class that is not there, a method with the wrong arguments, a method whose result has
    the wrong shape.
    """


class UnknownNameError(MirrorError):
    """Raised for a name, of a domain, a setting, an item and so on, that is not a known one."""

    # A constructor with other arguments than the message could not be unpickled, and so would break
    # the report of an error that a worker process raised.
    @classmethod
    def of(cls, kind: str, name: str, known: Iterable[str], where: str = "") -> Self:
        """The exception that says which names there are, and which of them was perhaps meant.

        Args:
            kind: what the name stands for, such as "domain".
            name: the name that was given.
            known: the names that would have been right.
            where: the domain, if it is another in others.
        """
        names = sorted(known)
        place = f" in {where}" if where else ""
        message = f'unknown {kind} "{name}"{place}; known: {", ".join(names) or "none"}'
        lowered = {candidate.lower(): candidate for candidate in names}
        for close in get_close_matches(name.lower(), lowered, n=1):
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


class OutputError(MirrorError):
    """Raised for a file or folder that cannot be created or written."""


class CheckpointError(MirrorError):
    """Raised for a checkpoint from which work cannot be resumed.

    It is damaged, or it belongs to a run with other options.
    """

"""Limits of users' numbers, and of the memory that they need."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from contextlib import suppress
from math import nan
from pathlib import Path
from typing import Any

from mirror_ppl.errors import OptionError

MOST_SEED = 2**32 - 1
"""Largest seed, in every command; mixed with other numbers, seeds fit into 64 bits."""
LIMITS: Mapping[str, tuple[int, int]] = {
    "seed": (0, MOST_SEED),
    "people_seed": (0, MOST_SEED),
    "people": (1, 1_000_000),
    "rounds": (1, 10_000),
    "train_rounds": (0, 1_000_000),
    "explore": (0, 1_000),
    "draws": (1, 100_000),
    "steps": (1, 1_000_000),
    "refine": (0, 1_000_000),
    "elbo_steps": (0, 1_000_000),
    "phases": (1, 100_000),
    "horizon": (1, 1_000),
    "patience": (1, 1_000),
    "played": (1, 10_000),
    "seeds": (1, 10_000),
    "jobs": (-1, 1_000),
}
"""Least and greatest value of whole numbers by the option's name, in every command alike."""

PICTURES = (".png", ".pdf", ".svg")
"""How names of files of pictures may end."""


def check_picture(path: Path | None, option: str) -> None:
    """Refuse a file of a picture of an unknown kind.

    Args:
        path: of the picture, if one was asked for.
        option: by which it was.

    Raises:
        OptionError: the path ends in none of ``PICTURES``.
    """
    if path is not None and path.suffix.lower() not in PICTURES:
        raise OptionError(f"{option} must end in {', '.join(PICTURES)}, not {path.name}")


def check_numbers(options: Any, *names: str, **least: int) -> None:
    """Refuse whole numbers outside of their limits.

    Args:
        options: object with the numbers as attributes; ``None`` and tuples are allowed.
        names: of the options.
        least: least values by name, for options with another one here.

    Raises:
        OptionError: a number is out of its limits; the message names them.
    """
    for name in (*names, *least):
        value = getattr(options, name)
        for number in value if isinstance(value, tuple) else (value,):
            if number is None:
                continue
            low, high = LIMITS[name]
            low = least.get(name, low)
            option = f"--{name.replace('_', '-')}"
            if number < low:
                raise OptionError(f"{option} must be at least {low}, not {number}")
            if name == "jobs" and number == 0:
                raise OptionError(f"{option} must be at least 1, or -1 for all, not 0")
            if number > high:
                raise OptionError(f"{option} must be at most {high}, not {number}")


def share(text: str, option: str) -> float:
    """Convert a percentage such as "2.5%" to a share from 0 to 1.

    Raises:
        OptionError: the text is not a percentage; the message says what is expected.
    """
    try:
        # A number alone might be meant as a share.
        percent = float(text.strip().removesuffix("%")) if "%" in text or text == "0" else nan
    except ValueError:
        percent = nan
    if not 0 <= percent <= 100:  # noqa: PLR2004 - per cent
        raise OptionError(f'{option} must be from 0% to 100%, such as 2.5%, not "{text}"')
    return percent / 100


def require_memory(needed: int, what: str) -> None:
    """Refuse work that does not fit into free memory.

    Args:
        needed: bytes.
        what: for the message, such as "rounds of so many people".

    Raises:
        OptionError: less memory is free; the message says how much.
    """
    free = free_memory()
    if free is not None and needed > free:
        raise OptionError(
            f"{what} would need about {needed / 2**30:,.1f} GB of memory, {free / 2**30:.1f} GB "
            "are free"
        )


def return_memory() -> None:
    """Return memory that was freed to the system, which the C library may keep for later.

    After many small arrays it keeps hundreds of megabytes. Nothing happens if it is not glibc.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def free_memory() -> int | None:
    """Bytes of memory that this process may still use; None where unknown."""
    free = []
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        sizes = {line.split(":")[0]: int(line.split()[1]) for line in lines}
        free.append(1024 * sizes["MemAvailable"])
    except (OSError, ValueError, KeyError, IndexError):
        pass
    try:
        group = Path("/sys/fs/cgroup")
        most, used = ((group / f"memory.{name}").read_text() for name in ("max", "current"))
        free.append(int(most) - int(used))
    except (OSError, ValueError):  # no such limit
        pass
    return min(free, default=None)

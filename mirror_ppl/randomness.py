"""Random states: generators by purpose, and blocks that leave the global state as it was."""

from __future__ import annotations

import hashlib
import re
from contextlib import AbstractContextManager

import torch

NUMBERED = re.compile(r"person-(0[1-9]|[1-9][0-9]{1,8})")
"""Ids that the package gives to people, who are counted from 1."""


def derived_generator(
    seed: int, *purpose: str | int, device: torch.device | str = "cpu"
) -> torch.Generator:
    """Return a separate generator for each seed and purpose.

    Seeds are hashed rather than added, so that neighbouring seeds are independent.
    """
    text = "/".join(map(str, (seed, *purpose)))
    digest = hashlib.blake2b(text.encode(), digest_size=8).digest()
    # Torch's seeds are signed.
    return torch.Generator(device).manual_seed(int.from_bytes(digest) >> 1)


def person_id(number: int) -> str:
    """Return the id that the package gives to a person by number, from 0, such as ``person-01``."""
    return f"person-{number + 1:02d}"


def number_of(person: str) -> int | None:
    """Return the number, from 0, of a person whose id the package gave, such as ``person-01``."""
    found = NUMBERED.fullmatch(person)
    return int(found[1]) - 1 if found else None


def person_seed(seed: int, person: str) -> int:
    """Return the seed of a person's draws, given that of the whole and the person's id.

    So results do not depend on who else is inferred, nor on the order, unless people are sampled
    together, as by `svi` and `nuts`. Ids that the package gives, such as ``person-01``, are counted
    from 0; others are hashed.
    """
    number = number_of(person)
    if number is None:
        number = int.from_bytes(hashlib.blake2b(person.encode(), digest_size=4).digest())
    return seed * 1_000_003 + number


def seed_everything(seed: int) -> None:
    """Seed the global random states of the processor and of CUDA devices.

    `torch.manual_seed` does the same, but formats and keeps the call stack for each other kind of
    device that is missing or not in use yet, which takes up to a millisecond.
    """
    torch.default_generator.manual_seed(seed)
    if torch.cuda.is_available():
        torch.cuda.manual_seed_all(seed)


def forked() -> AbstractContextManager[None]:
    """Return a context that restores the global random state of all devices at its end.

    Graphics processors are included once they are in use.
    """
    used = torch.cuda.is_initialized()
    return torch.random.fork_rng(devices=range(torch.cuda.device_count()) if used else [])

"""Damage to the bytes of a file, as storage, transfer and careless programs do it.

Each damage takes numpy's generator, so that a number reproduces it, and returns other bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

Random = np.random.Generator


def _place(random: Random, size: int) -> int:
    """Somewhere in a file; every other time near its beginning, where the structure stands."""
    near = random.random() < 0.5
    return int(random.integers(min(size, 4096) if near else size))


def flip_bits(random: Random, content: bytes) -> bytes:
    """A bit or a few are other ones."""
    changed = bytearray(content)
    for _ in range(int(random.choice([1, 1, 1, 2, 8]))):
        changed[_place(random, len(changed))] ^= 1 << int(random.integers(8))
    return bytes(changed)


def other_bytes(random: Random, content: bytes) -> bytes:
    """A run of bytes is replaced by others."""
    start, length = _place(random, len(content)), int(random.integers(1, 64))
    new = random.choice([b"\xff", b"\x00", random.bytes(1)]) * length
    if random.random() < 0.5:
        new = random.bytes(length)
    return content[:start] + new[: len(content) - start] + content[start + length :]


def zeroed(random: Random, content: bytes) -> bytes:
    """A run of bytes is zero, as where a disk lost blocks."""
    start, length = _place(random, len(content)), int(random.choice([8, 64, 512, 4096]))
    end = min(start + length, len(content))
    return content[:start] + bytes(end - start) + content[end:]


def truncated(random: Random, content: bytes) -> bytes:
    """The end is missing, from anywhere on."""
    return content[: int(random.integers(len(content)))]


def inserted(random: Random, content: bytes) -> bytes:
    """Bytes that were not there."""
    place, length = _place(random, len(content)), int(random.choice([1, 2, 4, 100]))
    return content[:place] + random.bytes(length) + content[place:]


def cut_out(random: Random, content: bytes) -> bytes:
    """Bytes that were there are not any more."""
    place, length = _place(random, len(content)), int(random.choice([1, 2, 4, 100]))
    return content[:place] + content[place + length :]


def swapped(random: Random, content: bytes) -> bytes:
    """Two blocks stand in each other's place."""
    size = int(random.choice([4, 64, 512, 4096]))
    first, second = sorted(random.integers(0, max(1, len(content) - size), 2).tolist())
    second = max(second, first + size)
    changed = bytearray(content)
    changed[first : first + size] = content[second : second + size]
    changed[second : second + size] = content[first : first + size]
    return bytes(changed)


def appended(random: Random, content: bytes) -> bytes:
    """More bytes after the end."""
    return content + random.bytes(int(random.choice([1, 100, 10_000])))


BYTES: Mapping[str, Callable[[Random, bytes], bytes]] = {
    made.__name__: made
    for made in (
        flip_bits,
        other_bytes,
        zeroed,
        truncated,
        inserted,
        cut_out,
        swapped,
        appended,
    )
}

"""Damage to files of weights (safetensors): to their numbers, and to what their header says."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from benchmarks._damage import Random

ODD = ("", "nan", "driving", "search_rescue", "{}", "[]", "null", "7", "\N{SNOWMAN}", "x" * 9999)
NUMBERS = (np.nan, np.inf, -np.inf, 1e38, 0.0)
ODD_SIZES = (0, -1, 1, 10**6, 10**9, 10**12, 2**63, "wide", None, 1.5, [1])


def _open(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The header, and what follows it."""
    (length,) = struct.unpack("<Q", content[:8])
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def _close(header: dict[str, Any], data: bytes) -> bytes:
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + data


def _tensor(random: Random, header: dict[str, Any]) -> str:
    return str(random.choice([name for name in header if name != "__metadata__"]))


def odd_weights(random: Random, content: bytes) -> bytes:
    """Weights that are no numbers, or none that were trained."""
    header, data = _open(content)
    start, end = header[_tensor(random, header)]["data_offsets"]
    values = np.frombuffer(data[start:end], "<f4").copy()
    number = int(random.choice([1, values.size]))
    values[random.integers(0, values.size, number)] = random.choice(NUMBERS)
    return _close(header, data[:start] + values.tobytes() + data[end:])


def other_weights(random: Random, content: bytes) -> bytes:
    """Weights that might have been trained, and were not."""
    header, data = _open(content)
    start, end = header[_tensor(random, header)]["data_offsets"]
    values = np.frombuffer(data[start:end], "<f4").copy()
    values = random.permutation(values) if random.random() < 0.5 else -values
    return _close(header, data[:start] + values.astype("<f4").tobytes() + data[end:])


def lost_tensor(random: Random, content: bytes) -> bytes:
    header, data = _open(content)
    del header[_tensor(random, header)]
    return _close(header, data)


def renamed_tensor(random: Random, content: bytes) -> bytes:
    header, data = _open(content)
    name = _tensor(random, header)
    header[str(random.choice([name + "x", "", "a.b", "\N{SNOWMAN}"]))] = header.pop(name)
    return _close(header, data)


def swapped_tensors(random: Random, content: bytes) -> bytes:
    header, data = _open(content)
    one, other = _tensor(random, header), _tensor(random, header)
    header[one], header[other] = header[other], header[one]
    return _close(header, data)


def other_entry(random: Random, content: bytes) -> bytes:
    """A tensor's shape, type or place is another."""
    header, data = _open(content)
    entry = header[_tensor(random, header)]
    kind = int(random.integers(5))
    if kind == 0:
        entry["shape"] = entry["shape"][::-1] if random.random() < 0.5 else [*entry["shape"], 1]
    elif kind == 1:
        entry["dtype"] = str(random.choice(["F64", "I32", "BF16", "F16", "U8", "odd"]))
    elif kind == 2:  # noqa: PLR2004
        entry["data_offsets"] = [int(random.integers(2**40)) for _ in range(2)]
    elif kind == 3:  # noqa: PLR2004
        entry["shape"] = [2**40, 2**40]
    else:
        entry.clear()
    return _close(header, data)


def odd_metadata(random: Random, content: bytes) -> bytes:
    header, data = _open(content)
    metadata = header["__metadata__"]
    metadata[str(random.choice(list(metadata)))] = str(random.choice(ODD))
    return _close(header, data)


def lost_metadata(random: Random, content: bytes) -> bytes:
    header, data = _open(content)
    if random.random() < 0.2:
        del header["__metadata__"]
    else:
        del header["__metadata__"][str(random.choice(list(header["__metadata__"])))]
    return _close(header, data)


def odd_sizes(random: Random, content: bytes) -> bytes:
    """Sizes of networks that nobody has."""
    header, data = _open(content)
    metadata = header["__metadata__"]
    if "sizes" not in metadata:
        return odd_metadata(random, content)
    sizes = json.loads(metadata["sizes"])
    sizes[str(random.choice([*sizes, "further"]))] = ODD_SIZES[int(random.integers(len(ODD_SIZES)))]
    metadata["sizes"] = json.dumps(sizes)
    return _close(header, data)


def odd_header(random: Random, content: bytes) -> bytes:
    """The header's length is wrong, or it is no JSON of the right kind."""
    kind = int(random.integers(3))
    if kind == 0:
        return struct.pack("<Q", int(random.choice([0, 1, 10**6, 10**12, 2**62]))) + content[8:]
    header, data = _open(content)
    if kind == 1:
        return _close([header] if random.random() < 0.5 else {}, data)  # type: ignore[arg-type]
    header["__metadata__"] = {
        name: {"a": [value]} for name, value in header["__metadata__"].items()
    }
    return _close(header, data)


OF_WEIGHTS: Mapping[str, Callable[[Random, bytes], bytes]] = {
    made.__name__: made
    for made in (
        odd_weights,
        other_weights,
        lost_tensor,
        renamed_tensor,
        swapped_tensors,
        other_entry,
        odd_metadata,
        lost_metadata,
        odd_sizes,
        odd_header,
    )
}

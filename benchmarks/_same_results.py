"""Whether two folders of results hold the same, but for times that were measured."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from safetensors import safe_open

TIMES = re.compile(r"second|milli|\bms\b|elapsed|created|duration")
"""In names of what is measured by the clock."""
TEMPORARY = re.compile(r"(^|/)\.|checkpoint|\.parts|\.lock|\.tmp")
PICTURES = (".png", ".pdf", ".svg")


def names_in(folder: Path) -> set[str]:
    """Files and folders, by their place in a folder."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def orphans(folder: Path, expected: set[str]) -> list[str]:
    """What an uninterrupted run did not leave, or should not have."""
    return sorted(
        name for name in names_in(folder) if name not in expected or TEMPORARY.search(name)
    )


def differences(one: Path, other: Path) -> list[str]:
    """Files of the first folder that the other lacks or has with another content."""
    found = []
    for path in sorted(one.rglob("*")):
        if not path.is_file():
            continue
        mine = path.relative_to(one)
        theirs = other / mine
        if not theirs.is_file() or theirs.stat().st_size == 0:
            found.append(f"{mine} is missing")
            continue
        why = _difference(path, theirs)
        if why:
            found.append(f"{mine}: {why}")
    return found


def _difference(one: Path, other: Path) -> str | None:
    if one.suffix in PICTURES:
        return None
    if one.suffix == ".nc":
        return _of_datasets(one, other)
    if one.suffix == ".json":
        return _of_json(json.loads(one.read_text()), json.loads(other.read_text()))
    if one.suffix == ".csv":
        return _of_rows(one, other)
    if one.suffix == ".log":
        pairs = zip(one.read_text().splitlines(), other.read_text().splitlines(), strict=False)
        for number, (mine, theirs) in enumerate(pairs):
            why = _of_json(json.loads(mine), json.loads(theirs))
            if why:
                return f"line {number}: {why}"
        return None if _lines(one) == _lines(other) else "other number of lines"
    if one.suffix == ".safetensors":
        return _of_weights(one, other)
    mine, theirs = (_without_times(path.read_text()) for path in (one, other))
    return None if mine == theirs else "other text"


def _lines(path: Path) -> int:
    return len(path.read_text().splitlines())


def _without_times(text: str) -> str:
    return "\n".join(line for line in text.splitlines() if not TIMES.search(line))


def _of_datasets(one: Path, other: Path) -> str | None:
    with h5py.File(one) as mine, h5py.File(other) as theirs:
        names: list[str] = []
        mine.visititems(
            lambda name, part: names.append(name) if isinstance(part, h5py.Dataset) else None
        )
        for name in names:
            if name not in theirs:
                return f"{name} is missing"
            first, second = np.asarray(mine[name][()]), np.asarray(theirs[name][()])
            if first.dtype.kind == "f":
                same = first.tobytes() == second.tobytes() and first.dtype == second.dtype
            else:
                same = first.dtype.kind == "O" or np.array_equal(first, second)
                same = same and first.tolist() == second.tolist()
            if not same:
                return f"{name} differs"
    return None


def _of_weights(one: Path, other: Path) -> str | None:
    """The order in which safetensors writes metadata is another each time."""
    with safe_open(one, "np") as mine, safe_open(other, "np") as theirs:
        if mine.metadata() != theirs.metadata():
            return "other metadata"
        names = set(mine.keys())
        if names != set(theirs.keys()):
            return "other tensors"
        for name in sorted(names):
            if mine.get_tensor(name).tobytes() != theirs.get_tensor(name).tobytes():
                return f"{name} differs"
    return None


def _of_json(one: Any, other: Any, place: str = "") -> str | None:
    if isinstance(one, dict) and isinstance(other, dict):
        if one.keys() != other.keys():
            return f"{place} has other keys"
        pairs = [(f"{place}.{key}", one[key], other[key]) for key in one if not TIMES.search(key)]
    elif isinstance(one, list) and isinstance(other, list):
        if len(one) != len(other):
            return f"{place} has another length"
        pairs = [(f"{place}[{i}]", *both) for i, both in enumerate(zip(one, other, strict=True))]
    else:
        same = one == other or (one != one and other != other)
        return None if same else f"{place} is {other}, not {one}"
    for name, mine, theirs in pairs:
        why = _of_json(mine, theirs, name)
        if why:
            return why
    return None


def _of_rows(one: Path, other: Path) -> str | None:
    with one.open(newline="") as first, other.open(newline="") as second:
        mine, theirs = list(csv.DictReader(first)), list(csv.DictReader(second))
    return _of_json(mine, theirs)

"""Damaged recordings, and whether the package refuses them or rightly accepts them."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import h5netcdf
import numpy as np
import torch
import xarray as xr

from benchmarks._damage import BYTES
from benchmarks._damage_datasets import ALL, EDITS, FIELDS, NOTHING, OF_VARIABLES
from benchmarks._damage_structure import OF_CLASSIC, OF_HDF5
from benchmarks._judging import ANOTHER, EQUAL, REFUSED, Verdict, fault_of, measured
from benchmarks._possible import contradictions
from mirror_ppl.data import (
    Demonstrations,
    asset_path,
    load_demonstrations,
    save_demonstrations,
    to_dataset,
)
from mirror_ppl.data.contradictions import check_world
from mirror_ppl.domains import get_domain
from mirror_ppl.inference.results.fitting import split_rounds
from mirror_ppl.people import simulate

DOMAINS = ("driving", "search_rescue", "bomb_defusal")
CHECKED, PLAIN, CLASSIC = "checked", "plain", "classic"
"""How a file is written: netCDF-4 by the package, netCDF-4 without checksums, netCDF-3."""
WAYS = CHECKED, PLAIN, CLASSIC
PACKED = {"zlib": True, "complevel": 4, "shuffle": True, "fletcher32": True}
CANNOT = (
    *(KeyError, ValueError, TypeError, IndexError, OverflowError, AttributeError, OSError),
    h5netcdf.CompatibilityError,
)
"""What a damage raises where it cannot be done, often because of another one before."""
SIMULATED = 6
ORIGINALS = 12


@dataclass(frozen=True)
class Case:
    """A damaged file.

    Attributes:
        original: number of the recording.
        content: the file.
        damage: what was done, in words.
        may_change: what of the recording may be another if the file is accepted.
    """

    original: int
    content: bytes
    damage: str
    may_change: frozenset[str]


@cache
def original(number: int) -> Demonstrations:
    """A small recording: simulated ones of every setting first, then shipped ones, cut down.

    Every third has rounds of different lengths.
    """
    places = [(name, setting) for name in DOMAINS for setting in get_domain(name).settings]
    domain, setting = places[number % len(places)]
    if number < SIMULATED:
        made = simulate(domain, setting, "diverse", 2, 3 + number % 3, number, told=0.2)
    else:
        name = f"{domain}_{setting}_paper.nc"
        made = load_demonstrations(asset_path(name)).select_people([0, 3]).select_rounds(range(3))
    if number % 3 == 0:
        variables = made.variables()
        random = np.random.default_rng(number)
        most = variables["action"].shape[-1]
        lengths = torch.from_numpy(random.integers(2, most + 1, tuple(variables["length"].shape)))
        lengths = torch.minimum(lengths, made.lengths)
        lengths[0, -1] = 0
        counts = (lengths > 0).sum(-1)
        made = Demonstrations.from_variables(
            domain, setting, made.people, variables | {"length": lengths, "round_count": counts}
        )
    return made


@cache
def dataset(number: int) -> xr.Dataset:
    """An original as a dataset; every second without what no fit needs, which is quicker."""
    full = to_dataset(original(number))
    if number % 2:
        full = full.drop_vars([name for name in full.data_vars if str(name) not in OF_VARIABLES])
    return full.load()


def save(path: Path, content: xr.Dataset, how: str) -> None:
    """Write a dataset as a file, in one of three ways."""
    if how == CLASSIC:
        content.to_netcdf(path, engine="scipy")
    elif how == PLAIN:
        content.to_netcdf(path, engine="h5netcdf")
    else:
        encoding = {
            str(name): PACKED
            for name, value in content.data_vars.items()
            if value.ndim and value.size and value.dtype.kind in "biufM"
        }
        content.to_netcdf(path, engine="h5netcdf", encoding=encoding)


@cache
def file_of(number: int, how: str) -> bytes:
    """An original as the bytes of a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "original.nc"
        if how == CHECKED:
            save_demonstrations(path, original(number))
        else:
            save(path, dataset(number), how)
        return path.read_bytes()


def make(seed: int, number: int, ways: Sequence[str] = WAYS, originals: int = ORIGINALS) -> Case:
    """A case, by its number; of the first recordings, written in one of some ways."""
    random = np.random.default_rng([seed, 1, number])
    chosen = int(random.integers(originals))
    how = str(random.choice(ways))
    kind = random.choice(["bytes", "edits", "structure"], p=[0.4, 0.45, 0.15])
    if kind == "edits":
        return _edited(random, chosen, how)
    content, damage = file_of(chosen, how), f"{_name(chosen)} {how}:"
    # Checksums are there to show that something changed; without any, nothing can.
    may_change = NOTHING if how == CHECKED else ALL
    if kind == "structure":
        kinds = OF_CLASSIC if how == CLASSIC else OF_HDF5
        for name in random.choice(list(kinds), _few(random)):
            content, touched = _tried(lambda n=name, c=content: kinds[n](random, c), content)
            may_change = may_change | _of(touched)
            damage += f" {name}({', '.join(sorted(touched))})"
        if random.random() < 0.8:
            return Case(chosen, content, damage, may_change)
    for name in random.choice(list(BYTES), _few(random)):
        if content:
            content = BYTES[name](random, content)
            damage += f" {name}"
    return Case(chosen, content, damage, may_change)


def _edited(random: np.random.Generator, chosen: int, how: str) -> Case:
    made, damage = dataset(chosen).copy(deep=True), f"{_name(chosen)} {how}:"
    may_change = NOTHING
    for name in random.choice(list(EDITS), _few(random)):
        try:
            made, changed = EDITS[name](random, made)
        except CANNOT:
            continue
        may_change = may_change | changed
        damage += f" {name}({', '.join(sorted(changed)) if len(changed) < len(FIELDS) else 'all'})"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "edited.nc"
        try:
            save(path, made, how)
            content = path.read_bytes()
        except (*CANNOT, UnicodeError, RuntimeError, NotImplementedError):
            content, damage = file_of(chosen, how)[:-100], damage + " (cannot be written: cut)"
    return Case(chosen, content, damage, may_change)


def _tried(
    damage: Callable[[], tuple[bytes, frozenset[str]]], content: bytes
) -> tuple[bytes, frozenset[str]]:
    try:
        return damage()
    except (*CANNOT, RuntimeError, MemoryError):
        return content, frozenset({"not done"})


def _of(touched: frozenset[str]) -> frozenset[str]:
    """What of a recording depends on variables and attributes of a file."""
    changed: set[str] = set()
    for name in touched:
        if name == "*":
            return ALL
        if name.startswith("@"):
            changed |= {"setting", "domain"} & {name[1:]}
        elif name == "person":
            changed.add("people")
        elif name.endswith(("_item", "_feature")):
            changed |= {"ego", "observations", "told"}
        elif name in OF_VARIABLES:
            changed.add(OF_VARIABLES[name])
        elif name in ("action_item", "round", "step", "time"):
            changed |= ALL
    return frozenset(changed)


def _few(random: np.random.Generator) -> int:
    return int(random.choice([1, 2, 3, 4], p=[0.6, 0.2, 0.1, 0.1]))


def _name(number: int) -> str:
    made = original(number)
    return f"{number} {made.domain} {made.setting}"


def load(path: Path) -> Demonstrations:
    """What a fit does with recordings before it infers anything."""
    recordings = load_demonstrations(path)
    check_world(recordings)
    split_rounds(recordings)
    return recordings


def judge(seed: int, number: int, keep: Path | None = None) -> Verdict:
    """Make a case and judge it; a file that shows a fault is kept in a folder."""
    return judge_case(make(seed, number), number, keep)


def judge_case(case: Case, number: int = 0, keep: Path | None = None) -> Verdict:
    """Judge a case; a file that shows a fault is kept in a folder."""
    folder = Path(tempfile.gettempdir()) if keep is None else keep
    path = folder / f"recording-{number}-{os.getpid()}.nc"
    path.write_bytes(case.content)
    outcome = measured(lambda: load(path))
    verdict = fault_of(outcome)
    if verdict is None:
        verdict = Verdict(REFUSED) if outcome.error else _compared(case, outcome.value)
    if verdict.good or keep is None:
        path.unlink()
    else:
        path.rename(folder / f"recording-{number}.nc")
    detail = verdict.detail or str(outcome.error or "")
    took = {"seconds": outcome.seconds, "megabytes": outcome.megabytes}
    return Verdict(verdict.kind, verdict.signature, detail, case.damage, **took)


def _compared(case: Case, found: Demonstrations) -> Verdict:
    """An accepted recording beside the original."""
    changed = different(original(case.original), found)
    if not changed:
        return Verdict(EQUAL)
    may_change = case.may_change
    if may_change & changed & {"lengths", "round_counts"}:
        # What stands behind the end of a round is not there any more.
        may_change = may_change | {"ego", "observations", "actions", "told"}
    unnoticed = changed - may_change
    if unnoticed:
        return Verdict("unnoticed", ", ".join(sorted(unnoticed)), f"changed: {sorted(changed)}")
    broken = contradictions(found)
    if broken:
        return Verdict("impossible", f"{found.domain}: {broken[0]}", "; ".join(broken))
    return Verdict(ANOTHER, ", ".join(sorted(changed)))


def different(one: Demonstrations, other: Demonstrations) -> set[str]:
    """What of two recordings a fit would use and differs."""
    found = {
        name
        for name in ("domain", "setting", "people")
        if getattr(one, name) != getattr(other, name)
    }
    if found & {"domain"} or one.actions.shape != other.actions.shape:
        return found | {"actions"}
    for name in ("ego", "actions", "round_counts", "lengths"):
        if not _same(getattr(one, name), getattr(other, name)):
            found.add(name)
    for name in ("observations", "told"):
        mine, theirs = getattr(one, name), getattr(other, name)
        if not all(_same(mine[key], theirs[key]) for key in mine):
            found.add(name)
    return found


def _same(one: torch.Tensor, other: torch.Tensor) -> bool:
    return one.shape == other.shape and bool(((one == other) | (one.isnan() & other.isnan())).all())

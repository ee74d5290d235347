"""Damaged posteriors, populations and weights, and whether the package reads anything from them."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import torch

from benchmarks._damage import BYTES
from benchmarks._damage_structure import OF_HDF5
from benchmarks._damage_weights import OF_WEIGHTS
from benchmarks._judging import ANOTHER, EQUAL, REFUSED, Verdict, fault_of, measured
from benchmarks._recording_cases import CANNOT, DOMAINS
from mirror_ppl.data import asset_path
from mirror_ppl.inference.population.pooling import Pooling
from mirror_ppl.inference.results.population_file import load_population
from mirror_ppl.inference.results.posterior_file import load_posterior
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.guide_file import load_guide

Values = Mapping[str, object]
POOLED = "pooled"
QUICK = ("--guide", "importance", "--draws", "20", "--train-rounds", "2", "--explore", "0")
GUIDES = {"driving_guide": None, "driving_guide_per_item": "per-item"}
WHOLE = 5
"""One of six versions of a posterior: with all groups, which is slow to read."""
KINDS = ("posterior", "population", "self-model", "guide")


@dataclass(frozen=True)
class Source:
    """A file as it should be, and how it is read."""

    name: str
    content: bytes
    read: Callable[[Path], Values]


def make_sources(folder: Path) -> None:
    """Fit a few rounds of each domain, unless that was done before with this package's weights."""
    folder.mkdir(parents=True, exist_ok=True)
    for domain in DOMAINS:
        few = "--people", 2, "--rounds", 3
        _command("simulate", folder / f"{domain}.nc", "--domain", domain, *few)
    for name in (*DOMAINS, POOLED):
        demos = folder / f"{'driving' if name == POOLED else name}.nc"
        pooling = ("--pooling", "partial") if name == POOLED else ()
        _command("fit", folder / name, "--demos", demos, *QUICK, *pooling)


def _command(name: str, out: Path, *arguments: object) -> None:
    made = out / "posterior.nc" if name == "fit" else out
    if made.is_file():
        return
    words = [sys.executable, "-m", f"mirror_ppl.{name}", "--out", out, *arguments]
    subprocess.run([str(word) for word in words], check=True, capture_output=True)


@cache
def human_of(domain: str, model: str | None = None) -> HumanModel:
    """A human model of the package."""
    return load_human_model(model, load_self_model(shipped_weights(domain), domain)[0])


def posterior_values(path: Path, domain: str) -> Values:
    """What `assist` reads of a posterior."""
    held = load_posterior(path)
    draws = held.draws(human_of(domain))
    return {"people": held.people, "setting": held.attributes.get("setting"), **draws}


def population_values(path: Path) -> Values:
    """What `fit --prior-from` reads of a posterior."""
    found = load_population(path, Pooling(human_of("driving")), "fog")
    parts = {"probabilities": found.probabilities, "mean": found.mean, "spread": found.spread}
    return {f"{name}_{part}": value for part, own in parts.items() for name, value in own.items()}


def weights_values(path: Path, domain: str) -> Values:
    """What every command reads of a self-model."""
    return dict(load_self_model(path, domain)[0].state_dict())


def guide_values(path: Path, model: str | None) -> Values:
    """What `--guide amortized` reads of a network."""
    return dict(load_guide(path, human_of("driving", model))[0].state_dict())


@cache
def source(folder: Path, kind: str, which: int) -> Source:
    """A file of a kind."""
    domain = DOMAINS[which % len(DOMAINS)]
    if kind == "posterior":
        whole = (folder / domain / "posterior.nc").read_bytes()
        content = whole if which == WHOLE else _only(whole, "posterior")
        return Source(f"{kind} {domain}", content, lambda path: posterior_values(path, domain))
    if kind == "population":
        whole = (folder / POOLED / "posterior.nc").read_bytes()
        content = whole if which == WHOLE else _only(whole, "posterior", "population")
        return Source(kind, content, population_values)
    if kind == "self-model":
        content = shipped_weights(domain).read_bytes()
        return Source(f"{kind} {domain}", content, lambda path: weights_values(path, domain))
    name, model = list(GUIDES.items())[which % len(GUIDES)]
    content = asset_path(f"{name}.safetensors").read_bytes()
    return Source(name, content, lambda path: guide_values(path, model))


@cache
def values_of(folder: Path, kind: str, which: int) -> Values:
    """What is read of the undamaged file."""
    made = source(folder, kind, which)
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "undamaged"
        path.write_bytes(made.content)
        return made.read(path)


def _only(content: bytes, *groups: str) -> bytes:
    """A file with some of its groups, so that more of the damage meets them."""
    buffer = io.BytesIO(content)
    with h5py.File(buffer, "r+") as file:
        for name in [name for name in file if name not in groups]:
            del file[name]
    return buffer.getvalue()


def make(folder: Path, seed: int, number: int) -> tuple[Source, str, bytes, str, frozenset[str]]:
    """A source and its key, a damaged file, what was done, and which values may be others."""
    random = np.random.default_rng([seed, 2, number])
    kind, which = str(random.choice(KINDS, p=[0.4, 0.2, 0.25, 0.15])), int(random.integers(6))
    made = source(folder, kind, which)
    content, damage, may_change = made.content, f"{made.name}:", set()
    few = int(random.choice([1, 2, 3], p=[0.7, 0.2, 0.1]))
    if random.random() < 0.6:
        kinds = OF_HDF5 if kind in ("posterior", "population") else OF_WEIGHTS
        for name in random.choice(list(kinds), few):
            try:
                changed = kinds[name](random, content)
            except (*CANNOT, RuntimeError, MemoryError):
                continue
            if isinstance(changed, tuple):
                changed, touched = changed
                may_change |= {part.rsplit("/")[-1].strip("@") for part in touched}
                name = f"{name}({', '.join(sorted(touched))})"
            content, damage = changed, f"{damage} {name}"
    if content is made.content or random.random() < 0.1:
        for name in random.choice(list(BYTES), few):
            if content:
                content, damage = BYTES[name](random, content), f"{damage} {name}"
    return made, f"{kind} {which}", content, damage, frozenset(may_change)


def judge(folder: Path, seed: int, number: int, keep: Path | None = None) -> Verdict:
    """Make a case and judge it; a file that shows a fault is kept in a folder."""
    made, key, content, damage, may_change = make(folder, seed, number)
    kind, which = key.rsplit(" ", 1)
    place = Path(tempfile.gettempdir()) if keep is None else keep
    suffix = ".nc" if kind in ("posterior", "population") else ".safetensors"
    expected = values_of(folder, kind, int(which))
    path = place / f"result-{number}-{os.getpid()}{suffix}"
    path.write_bytes(content)
    outcome = measured(lambda: made.read(path))
    verdict = fault_of(outcome)
    if verdict is None:
        if outcome.error:
            verdict = Verdict(REFUSED)
        else:
            verdict = _compared(kind, expected, outcome.value, may_change)
    if verdict.good or keep is None:
        path.unlink()
    else:
        path.rename(place / f"result-{number}{suffix}")
    took = {"seconds": outcome.seconds, "megabytes": outcome.megabytes}
    detail = verdict.detail or str(outcome.error or "")
    return Verdict(verdict.kind, verdict.signature, detail, damage, **took)


def _compared(kind: str, expected: Values, found: Values, may_change: frozenset[str]) -> Verdict:
    changed = {name for name in expected.keys() | found.keys() if not _same(expected, found, name)}
    if not changed:
        return Verdict(EQUAL)
    for name in changed:
        value = found.get(name)
        if isinstance(value, torch.Tensor) and not value.isfinite().all():
            return Verdict("impossible", f"{kind}: not finite", f"{name} is not finite")
    names = may_change | ({"people"} if "person" in may_change else set())
    unnoticed = set() if "*" in names else changed - names
    if unnoticed:
        some = ", ".join(sorted(unnoticed)[:5])
        return Verdict("unnoticed", kind, f"{len(unnoticed)} of {len(expected)} values: {some}")
    return Verdict(ANOTHER, kind)


def _same(one: Values, other: Values, name: str) -> bool:
    mine, theirs = one.get(name), other.get(name)
    if isinstance(mine, torch.Tensor) and isinstance(theirs, torch.Tensor):
        return mine.shape == theirs.shape and bool(torch.equal(mine, theirs))
    return mine is not None and mine == theirs

"""How fast this version is beside another one, both measured in one run.

    python -m benchmarks.speed --against 5008c39 --repeats 3

The other revision is checked out into a temporary folder. Every measurement is made by both in
turn, in processes of their own, so that whatever else the machine does weighs on both. The table
holds the median of each and their ratio, with the smallest and the largest ratio of a turn; below 1
this version is the quicker one. Measured are `fit` of the recordings that ship (all of the command,
by importance), a decision of the communicator with default settings, and a round that is added to a
person's posterior.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from time import perf_counter

import tyro

from benchmarks._state import ROOT

WORK = Path(__file__).with_name("_speed_work.py")
WORLDS = (("driving", "fog"), ("search_rescue", "smoke"), ("bomb_defusal", "unlabelled"))
Measure = Callable[[Path], dict[str, float]]


@dataclass(frozen=True)
class Options:
    """What to compare."""

    against: str = "5008c39"
    """The other revision; version 0.1.0 unless given."""
    repeats: int = 3
    """How often each of the two does each measurement."""
    only: str = ""
    """Measurements whose name contains this; all unless given."""
    out: Path = Path("runs/speed.csv")
    """File for the table."""


def main(options: Options) -> None:
    measurements = {name: call for name, call in all_measurements().items() if options.only in name}
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        git("worktree", "add", "--detach", str(other), options.against)
        try:
            rows = [
                row
                for name, call in measurements.items()
                for row in compare(name, call, other, options.repeats)
            ]
        finally:
            git("worktree", "remove", "--force", str(other))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def all_measurements() -> dict[str, Measure]:
    """The measurements by name."""
    found: dict[str, Measure] = {
        f"fit {domain}": lambda tree, d=domain: fit(tree, d) for domain, _ in WORLDS
    }
    found["plan driving"] = lambda tree: work(tree, "plan")
    for domain, setting in WORLDS:
        found[f"add {domain}"] = lambda tree, d=domain, s=setting: work(tree, "add", d, s, "none")
    found["add driving, network"] = lambda tree: work(tree, "add", "driving", "fog", "network")
    return found


def compare(name: str, call: Measure, other: Path, repeats: int) -> list[dict[str, object]]:
    """Rows of the table, one for each number that a measurement has."""
    turns = [(call(ROOT), call(other)) for _ in range(repeats)]
    rows = []
    for key in turns[0][0]:
        ratios = sorted(here[key] / there[key] for here, there in turns)
        row = {
            "measurement": name,
            "unit": key,
            "this": round(median(here[key] for here, _ in turns), 2),
            "other": round(median(there[key] for _, there in turns), 2),
            "ratio": round(median(ratios), 2),
            "least": round(ratios[0], 2),
            "most": round(ratios[-1], 2),
        }
        print(*(f"{value!s:>14}" for value in row.values()), flush=True)
        rows.append(row)
    return rows


def fit(tree: Path, domain: str) -> dict[str, float]:
    """Seconds of `fit` of the ten people that ship, by importance."""
    with tempfile.TemporaryDirectory() as out:
        began = perf_counter()
        # The engine's name in version 0.1.0, which this version still takes.
        run(tree, "-m", "mirror_ppl.fit", "--domain", domain, "--guide", "exact", "--out", out)
        return {"seconds": perf_counter() - began}


def work(tree: Path, *arguments: str) -> dict[str, float]:
    """What _speed_work.py measures there."""
    return json.loads(run(tree, str(WORK), *arguments).splitlines()[-1])


def run(tree: Path, *arguments: str) -> str:
    """Output of Python with the package of that folder."""
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    environment["PYTHONWARNINGS"] = "ignore"
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=tree,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments)} in {tree.name}:\n{done.stderr}")
    return done.stdout


def git(*arguments: str) -> None:
    """Call git in this repository."""
    subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

"""How fast this version is beside another one, both measured in one run.

    python -m benchmarks.speed --against 5008c39 --repeats 3

The other revision is checked out into a temporary folder. Every measurement is made by both in
turn, in processes of their own, so that whatever else the machine does weighs on both. The table
holds the median of each and their ratio, with the smallest and the largest ratio of a turn; below 1
this version is the quicker one. Measured are `fit` of the recordings that ship and of 40 simulated
people (all of the command, by importance, as it shares the cores; with its largest memory, of all
its processes together), a decision of the communicator with default settings, the posterior of a
new person with 20 rounds, and a round that is added to one. Threads are one but in fits.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from time import perf_counter, sleep

import psutil
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
        f"fit {domain}": lambda tree, d=domain: fit(tree, "--domain", d) for domain, _ in WORLDS
    }
    found["fit 40 people"] = fit_many
    found["plan driving"] = lambda tree: work(tree, "plan")
    for domain, setting in WORLDS:
        found[f"add {domain}"] = lambda tree, d=domain, s=setting: work(tree, "add", d, s, "none")
    found["new person driving"] = lambda tree: work(tree, "arrive", "driving", "fog")
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


def fit(tree: Path, *arguments: str) -> dict[str, float]:
    """Seconds and megabytes of `fit` by importance."""
    with tempfile.TemporaryDirectory() as out:
        # The engine's name in version 0.1.0, which this version still takes.
        command = ["-m", "mirror_ppl.fit", *arguments, "--guide", "exact", "--out", out]
        began, watch = perf_counter(), Memory()
        run(tree, *command, threads=None, watch=watch)
        return {"seconds": perf_counter() - began, "megabytes": watch.most}


def fit_many(tree: Path) -> dict[str, float]:
    """Of 40 simulated people who drive in fog, without looking for the most informative round."""
    with tempfile.TemporaryDirectory() as folder:
        rounds = str(Path(folder) / "many.nc")
        people = ("--people", "40", "--rounds", "40", "--setting", "fog", "--seed", "100")
        run(ROOT, "-m", "mirror_ppl.simulate", *people, "--out", rounds)
        return fit(tree, "--demos", rounds, "--explore", "0")


class Memory:
    """The largest memory of a process and all that it starts, looked at now and then.

    Attributes:
        most: in megabytes; pages that several share count once.
    """

    def __init__(self) -> None:
        self.most = 0.0

    def look(self, process: psutil.Process) -> None:
        """Look once."""
        total = 0
        for one in (process, *process.children(recursive=True)):
            with suppress(psutil.Error):
                total += one.memory_full_info().pss
        self.most = max(self.most, total / 2**20)


def work(tree: Path, *arguments: str) -> dict[str, float]:
    """What _speed_work.py measures there."""
    return json.loads(run(tree, str(WORK), *arguments).splitlines()[-1])


def run(tree: Path, *arguments: str, threads: int | None = 1, watch: Memory | None = None) -> str:
    """Output of Python with the package of that folder."""
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONWARNINGS": "ignore"}
    if threads is not None:
        environment["OMP_NUM_THREADS"] = str(threads)
    with tempfile.TemporaryFile("w+") as said, tempfile.TemporaryFile("w+") as wrong:
        process = psutil.Popen(
            [sys.executable, *arguments], cwd=tree, env=environment, stdout=said, stderr=wrong
        )
        while process.poll() is None:
            if watch is not None:
                watch.look(process)
            sleep(0.1)
        said.seek(0)
        wrong.seek(0)
        if process.returncode:
            raise SystemExit(f"{' '.join(arguments)} in {tree.name}:\n{wrong.read()}")
        return said.read()


def git(*arguments: str) -> None:
    """Call git in this repository."""
    subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

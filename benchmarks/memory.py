"""How much memory a fit needs, by the number of people.

    python -m benchmarks.memory --people 50 100 200

Simulates people, fits them with the options of `python -m mirror_ppl.fit`, each time in a process
of its own, and prints its largest resident memory, the size of its results in memory (all variables
of posterior.nc, uncompressed), and how both grow with each person, from the row before.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import h5py

KILOBYTE = 1024
MEGABYTE = 1024**2


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, nargs="+", default=[50, 100, 200])
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--domain", default="driving")
    parser.add_argument("--setting", default="fog")
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--guide", default="importance")
    options = parser.parse_args()
    print("people  seconds  peak MB  results MB  peak/person  results/person", flush=True)
    before = None
    for people in options.people:
        with TemporaryDirectory() as folder:
            seconds, peak, results = measured(Path(folder), people, options)
        growth = ""
        if before is not None and people != before[0]:
            more = people - before[0]
            growth = f"{(peak - before[1]) / more:11.2f}  {(results - before[2]) / more:14.2f}"
        print(f"{people:6d}  {seconds:7.0f}  {peak:7.0f}  {results:10.1f}  {growth}", flush=True)
        before = people, peak, results


def measured(folder: Path, people: int, options: argparse.Namespace) -> tuple[float, float, float]:
    """Seconds of a fit, its largest resident memory, and the size of its results, in MB."""
    recordings, out = folder / "people.nc", folder / "fit"
    of_people = ["--domain", options.domain, "--setting", options.setting]
    number = ["--people", str(people), "--rounds", str(options.rounds)]
    seed = ["--seed", str(options.seed)]
    run("simulate", *of_people, *number, *seed, "--out", str(recordings))
    began = perf_counter()
    peak = run("fit", "--demos", str(recordings), "--guide", options.guide, "--out", str(out))
    return perf_counter() - began, peak, held(out / "posterior.nc")


def run(command: str, *arguments: str) -> float:
    """Run a command of the package; returns its largest resident memory in MB."""
    # This process has to stay small: a child's peak counts from what its parent had in memory.
    child = subprocess.Popen(
        [sys.executable, "-m", f"mirror_ppl.{command}", *arguments],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{command} {' '.join(arguments)} ended with {child.returncode}")
    return usage.ru_maxrss * KILOBYTE / MEGABYTE


def held(path: Path) -> float:
    """Size of all variables of a netCDF file, uncompressed, in MB."""
    sizes = []

    def add(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            sizes.append(item.nbytes)

    with h5py.File(path) as file:
        file.visititems(add)
    return sum(sizes) / MEGABYTE


if __name__ == "__main__":
    main()

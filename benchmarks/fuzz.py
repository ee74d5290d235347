"""Damaged files and wrong command lines by the thousand: is all of it refused, and in one line?

    python -m benchmarks.fuzz --recordings 10000 --results 2000 --commands 500

Small recordings, posteriors, populations and weights are damaged, in their bytes and in what they
hold, and read as the commands read them. Command lines are put together of good, bad and extreme
values and run in folders of their own. Good is what is refused in one line, or accepted and equal
to the original, or another file that a user might have made. Everything else is a fault:
another exception, more than 10 seconds or 500 MB, a process that dies, a change that goes in
unnoticed, a recording that cannot have happened, anything left behind by a refused command.

Verdicts are kept as they come, and a run that is stopped goes on where it was, as long as the
package is the same. Printed are counts of verdicts and every kind of fault with the number of its
first case; ``--show recordings 17`` judges one case again and prints all about it. The exit status
is 1 if there was a fault.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any

import torch

from benchmarks import _recording_cases, _result_cases
from benchmarks._judging import MOST_WORK, Verdict, run_cases
from benchmarks._state import package

PARTS = ("recordings", "results", "commands")
NUMBERS = {"recordings": 10_000, "results": 2000, "commands": 500}
EVERY = 30.0
"""Seconds between lines of progress."""


def work_of(part: str, out: Path, seed: int, keep: Path | None) -> Callable[[int], Verdict]:
    """What judges a case of a part."""
    if part == "recordings":
        return partial(_recording_cases.judge, seed, keep=keep)
    if part == "results":
        return partial(_result_cases.judge, out / "sources", seed, keep=keep)
    from benchmarks import _command_cases

    _command_cases.preload()
    return partial(_command_cases.judge, out / "sources", seed, keep=keep)


def judge_all(part: str, number: int, out: Path, seed: int, jobs: int) -> dict[int, Verdict]:
    """Verdicts of all cases of a part; those that an earlier run left are read."""
    path = out / f"{part}-{seed}-{package()}.csv"
    done = dict(_read(path))
    todo = [case for case in range(number) if case not in done]
    keep = out / "faults"
    keep.mkdir(parents=True, exist_ok=True)
    said = began = monotonic()
    with path.open("a", newline="") as file:
        rows = csv.DictWriter(file, ["case", *(field.name for field in fields(Verdict))])
        if not done:
            rows.writeheader()
        for judged, (case, verdict) in enumerate(
            run_cases(work_of(part, out, seed, keep), todo, jobs), 1
        ):
            done[case] = verdict
            rows.writerow({"case": case} | asdict(verdict))
            file.flush()
            if monotonic() - said > EVERY:
                said = monotonic()
                faults = sum(not one.good for one in done.values())
                left = (said - began) / judged * (len(todo) - judged) / 60
                text = f"{part}: {len(done)}/{number}, {faults} faults, {left:.0f} min left"
                print(text, file=sys.stderr, flush=True)
    return {case: done[case] for case in sorted(done) if case < number}


def _read(path: Path) -> Iterator[tuple[int, Verdict]]:
    if not path.is_file():
        return
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            numbers = {name: float(row[name]) for name in ("seconds", "megabytes")}
            texts = {name: row[name] for name in ("kind", "signature", "detail", "damage")}
            yield int(row["case"]), Verdict(**texts, **numbers)


def faults_of(verdicts: dict[int, Verdict]) -> list[dict[str, Any]]:
    """One row for every kind of fault: how often, and its first case."""
    kinds: dict[tuple[str, str], list[int]] = {}
    for case, verdict in verdicts.items():
        if not verdict.good:
            kinds.setdefault((verdict.kind, verdict.signature), []).append(case)
    return [
        {
            "fault": kind,
            "what": signature,
            "number": len(cases),
            "first": cases[0],
            "cases": " ".join(map(str, cases[:5])),
            "damage": verdicts[cases[0]].damage,
            "detail": verdicts[cases[0]].detail.strip().splitlines()[-1:],
        }
        for (kind, signature), cases in sorted(kinds.items(), key=lambda item: -len(item[1]))
    ]


def report(part: str, verdicts: dict[int, Verdict], out: Path, seed: int) -> int:
    """Print and write what was found; returns how many faults there are."""
    counts = Counter(verdict.kind for verdict in verdicts.values())
    slowest = max((verdict.seconds for verdict in verdicts.values()), default=0.0)
    largest = max((verdict.megabytes for verdict in verdicts.values()), default=0.0)
    print(f"\n{part}: {len(verdicts)} cases, the slowest {slowest:.1f} s, at most {largest:.0f} MB")
    for kind, number in counts.most_common():
        print(f"  {number:6d}  {kind}")
    another = Counter(one.signature for one in verdicts.values() if one.kind == "another")
    for what, number in another.most_common(12):
        print(f"  {number:6d}  accepted with another: {what}")
    faults = faults_of(verdicts)
    for row in faults:
        print(f"  fault {row['fault']}: {row['what']} ({row['number']}; cases {row['cases']})")
        print(f"    {row['damage'][:200]}")
        print(f"    {' '.join(row['detail'])[:200]}")
        print(f"    python -m benchmarks.fuzz --seed {seed} --show {part} {row['first']}")
    if faults:
        with (out / f"{part}-faults.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, list(faults[0]))
            table.writeheader()
            table.writerows(faults)
    with (out / f"{part}-summary.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["verdict", "what", "number"])
        every = Counter((one.kind, one.signature) for one in verdicts.values())
        rows.writerows([kind, what, number] for (kind, what), number in every.most_common())
    return sum(row["number"] for row in faults)


def show(part: str, case: int, out: Path, seed: int) -> int:
    """Judge one case again, and print all about it."""
    ((_, verdict),) = run_cases(work_of(part, out, seed, out), [case], 1)
    for name, value in asdict(verdict).items():
        print(f"{name}: {value}")
    return 0 if verdict.good else 1


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    for part, number in NUMBERS.items():
        parser.add_argument(f"--{part}", type=int, default=number)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("runs/fuzz"))
    parser.add_argument("--show", nargs=2, metavar=("PART", "CASE"), help="one case alone")
    options = parser.parse_args()
    torch.set_num_threads(1)
    out = options.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    wanted = {part: getattr(options, part) for part in PARTS}
    parts = [options.show[0]] if options.show else [part for part in PARTS if wanted[part]]
    if parts != ["recordings"]:
        # What was fitted with other weights is no undamaged file of this package.
        _result_cases.make_sources(out / f"sources-{package()}")
    (out / "sources").unlink(missing_ok=True)
    (out / "sources").symlink_to(out / f"sources-{package()}")
    if options.show:
        return show(options.show[0], int(options.show[1]), out, options.seed)
    faults = 0
    for part, number in wanted.items():
        if number:
            verdicts = judge_all(part, number, out, options.seed, options.jobs)
            faults += report(part, verdicts, out, options.seed)
    print(f"\n{faults} faults; cases at work for {MOST_WORK:.0f} s were ended")
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())

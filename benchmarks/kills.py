"""Commands that are killed at any moment: does the same command, given again, end as if not?

    python -m benchmarks.kills --kills 50

Each command runs once without interruption. Then it runs in fresh folders and gets a signal at a
random moment: SIGKILL, SIGTERM, SIGINT, or SIGINT to the whole process group, as a terminal sends
it. The same command is given again until it ends by itself, sometimes with a second signal. Its
results have to be those of the uninterrupted run, but for times, and no file may be left that it
did not leave. Ten seconds after a signal no process may be left; after SIGTERM and SIGINT the
command has to end within 3 seconds, with status 143 or 130 and one line. Printed is a row for each
command and signal, and every fault; the exit status is 1 if there was one.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, sleep

import numpy as np

from benchmarks._same_results import differences, names_in, orphans
from benchmarks._state import ROOT, package

MARK = "MIRROR_PPL_KILLS"
"""Environment variable by which processes of a run are found."""
SOON, LATER = 3.0, 10.0
"""Seconds in which a command has to end, and after which no process of it may be left."""
FIRST = 1.5
"""Seconds of every run without a signal: in them Python itself starts."""
LONGEST = 600.0
"""Seconds after which a run counts as hung."""
FIT = "fit", "--demos", "people.nc", "--train-rounds", "4", "--out", "out", "--explore", "0"
COMMANDS: dict[str, tuple[str, ...]] = {
    "fit": (*FIT, "--draws", "50"),
    "fit svi": (*FIT, "--guide", "svi", "--steps", "60", "--draws", "20"),
    "fit pooled": (*FIT, "--pooling", "partial", "--draws", "20"),
    "train": ("train", "--phases", "3", "--steps", "5", "--out", "out/w.safetensors"),
    "train guide": ("train", "--what", "guide", "--people", "10", "--out", "out/g.safetensors"),
    "assist": ("assist", "--posterior", "posterior.nc", "--rounds", "2", "--draws", "8")
    + ("--people", "2", "--communicator", "mirror", "none", "all", "--jobs", "2")
    + ("--json", "out/a.json", "--log", "out/a.log"),
    "calibrate": ("calibrate", "--people", "10", "--rounds", "1", "--draws", "10", "--jobs", "2")
    + ("--out", "out"),
    "evaluate": ("evaluate", "prediction", "--people", "1", "--seeds", "2", "--rounds", "1", "2")
    + ("--models", "bc", "logistic", "--setting", "fog", "--jobs", "2", "--out", "out"),
}
"""Each takes some 10 to 30 seconds where nothing else is at work."""
SIGNALS = {
    "SIGKILL": (signal.SIGKILL, False),
    "SIGTERM": (signal.SIGTERM, False),
    "SIGINT": (signal.SIGINT, False),
    "Ctrl-C": (signal.SIGINT, True),
}
"""Which signal, and whether the process group gets it."""
ENDS = {signal.SIGTERM: (143, -15), signal.SIGINT: (130, -2)}
PROGRESS = re.compile(r"^[\w -]+: \d+(/\d+)?\b.*, (\d+ (h|min|s) ?)+(, .* left)?$")
SECOND = 0.3
"""How often the second run gets a signal, too."""


@dataclass
class Tally:
    """What came of the kills of a command by a signal."""

    kills: int = 0
    equal: int = 0
    orphans: int = 0
    left: int = 0
    slowest: float = 0.0
    faults: list[str] = field(default_factory=list)


class Run:
    """A command at work in a folder."""

    def __init__(self, words: Sequence[str], folder: Path) -> None:
        self.mark = f"{os.getpid()}-{id(self)}-{monotonic()}"
        environment = os.environ | {MARK: self.mark, "PYTHONPATH": str(ROOT)}
        self.errors = folder.with_suffix(".stderr").open("w+b")
        self.began = monotonic()
        self.process = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-m", f"mirror_ppl.{words[0]}", *words[1:]],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self.errors,
            start_new_session=True,
        )

    def wait(self, seconds: float) -> int | None:
        """The exit status, or `None` if it has not ended by then."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def send(self, number: signal.Signals, group: bool) -> None:
        """Send a signal to the process, or to all of its group."""
        (os.killpg if group else os.kill)(self.process.pid, number)

    def said(self) -> list[str]:
        """Lines on stderr but for those of progress."""
        self.errors.seek(0)
        lines = self.errors.read().decode(errors="replace").splitlines()
        return [line for line in lines if line.strip() and not PROGRESS.match(line)]

    def processes(self) -> list[int]:
        """Those that are alive and inherited the environment."""
        found = []
        wanted = f"{MARK}={self.mark}".encode()
        for path in Path("/proc").glob("[0-9]*/environ"):
            try:
                if wanted in path.read_bytes().split(b"\0"):
                    found.append(int(path.parent.name))
            except OSError:
                continue
        return found

    def gone(self) -> list[int]:
        """Processes that are left, after as long as they may take; ended then."""
        end = monotonic() + LATER
        while (left := self.processes()) and monotonic() < end:
            sleep(0.2)
        for process in left:
            os.kill(process, signal.SIGKILL)
        self.errors.close()
        return left


def uninterrupted(name: str, out: Path, inputs: Path) -> tuple[Path, float]:
    """The folder of a run that nobody interrupts, and the seconds that it took."""
    folder = out / name.replace(" ", "-")
    noted = folder.with_suffix(".seconds")
    if noted.is_file():
        return folder, float(noted.read_text())
    _fresh(folder, inputs)
    run = Run(COMMANDS[name], folder)
    status = run.wait(LONGEST)
    seconds = monotonic() - run.began
    said = run.said()
    run.gone()
    if status not in _good(name):
        raise SystemExit(f"{name} ends with {status} when nobody interrupts it: {said[-1:]}")
    noted.write_text(f"{seconds}")
    print(f"{name}: {seconds:.0f} s without interruption", flush=True)
    return folder, seconds


def kill_and_go_on(
    name: str, kind: str, moments: list[float], folder: Path, whole: Path, tally: Tally
) -> None:
    """Interrupt a command at some moments, let it end, and compare."""
    number, group = SIGNALS[kind]
    for moment in moments:
        run = Run(COMMANDS[name], folder)
        if run.wait(moment) is not None:  # it was quicker than the signal
            run.gone()
            continue
        run.send(number, group)
        sent = monotonic()
        status = run.wait(60.0)
        took = monotonic() - sent
        if status is None:
            run.send(signal.SIGKILL, True)
            tally.faults.append(f"{moment:.1f} s: does not end within 60 s of the signal")
        said = run.said()
        tally.kills += 1
        left = run.gone()
        tally.left += len(left)
        if left:
            tally.faults.append(f"{moment:.1f} s: {len(left)} processes are left")
        if number in ENDS and status is not None and status not in _good(name):
            tally.slowest = max(tally.slowest, took)
            tally.faults += [
                f"{moment:.1f} s: {why}" for why in _ending(number, status, took, said)
            ]
    run = Run(COMMANDS[name], folder)
    status, said = run.wait(LONGEST), run.said()
    if status is None:
        run.send(signal.SIGKILL, True)
    run.gone()
    at = " and ".join(f"{moment:.1f}" for moment in moments)
    if status not in _good(name):
        tally.faults.append(f"{at} s: the next run ends with {status}: {' '.join(said[-1:])[:200]}")
        return
    others = differences(whole, folder)
    tally.equal += not others
    tally.faults += [f"{at} s: {why}" for why in others[:3]]
    files = orphans(folder, names_in(whole))
    tally.orphans += len(files)
    if files:
        tally.faults.append(f"{at} s: left behind: {', '.join(files[:5])}")


def _ending(number: signal.Signals, status: int, took: float, said: list[str]) -> list[str]:
    wrong = []
    if took > SOON:
        wrong.append(f"{took:.1f} s to end")
    if status not in ENDS[number]:
        wrong.append(f"status {status}, not {ENDS[number][0]}")
    if len(said) != 1:
        wrong.append(f"{len(said)} lines on stderr: {' | '.join(said[-3:])[:300]}")
    return wrong


def _good(name: str) -> tuple[int, ...]:
    """Exit status of a run that came to its end; calibration may be rejected."""
    return (0, 1) if name == "calibrate" else (0,)


def _fresh(folder: Path, inputs: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(inputs, folder)


def make_inputs(folder: Path) -> None:
    """Recordings of a few people, and a posterior of them."""
    if (folder / "posterior.nc").is_file():
        return
    folder.mkdir(parents=True, exist_ok=True)
    people = "--people", "4", "--rounds", "8", "--out", "people.nc"
    fit = "--demos", "people.nc", "--draws", "50", "--explore", "0", "--out", "out"
    for name, words in (("simulate", people), ("fit", fit)):
        command = [sys.executable, "-W", "ignore", "-m", f"mirror_ppl.{name}", *words]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
    (folder / "out" / "posterior.nc").rename(folder / "posterior.nc")
    shutil.rmtree(folder / "out")


def main() -> int:
    """Run the study."""
    # Started in the background of a shell it would be ignored, by the commands as well.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="+", default=list(COMMANDS), choices=list(COMMANDS))
    parser.add_argument("--signals", nargs="+", default=list(SIGNALS), choices=list(SIGNALS))
    parser.add_argument("--out", type=Path, default=Path("runs/kills"))
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    out = options.out.resolve()
    # What this package left without interruption is kept from one run to the next.
    inputs, kept = out / f"inputs-{package()}", out / f"whole-{package()}"
    make_inputs(inputs)
    kept.mkdir(exist_ok=True)
    wholes = {name: uninterrupted(name, kept, inputs) for name in options.commands}
    tallies: dict[tuple[str, str], Tally] = {}
    for number in range(options.kills):
        name = options.commands[number % len(options.commands)]
        turn = number // len(options.commands) + number
        kind = options.signals[turn % len(options.signals)]
        whole, seconds = wholes[name]
        moments = FIRST + random.random(1 + (random.random() < SECOND)) * max(0.5, seconds - FIRST)
        tally = tallies.setdefault((name, kind), Tally())
        folder = out / f"{name.replace(' ', '-')}-{number}"
        _fresh(folder, inputs)
        known = len(tally.faults)
        kill_and_go_on(name, kind, moments.tolist(), folder, whole, tally)
        for fault in tally.faults[known:]:
            print(f"  {number} {name}, {kind}, {fault}", flush=True)
        if len(tally.faults) == known:
            shutil.rmtree(folder)
    return _report(tallies)


def _report(tallies: dict[tuple[str, str], Tally]) -> int:
    print("\ncommand       signal    kills  equal  orphan files  processes left  slowest end, s")
    for (name, kind), one in sorted(tallies.items()):
        row = f"{name:13s} {kind:8s} {one.kills:6d} {one.equal:6d} {one.orphans:13d}"
        print(f"{row} {one.left:15d} {one.slowest:16.1f}")
    faults = sum(len(one.faults) for one in tallies.values())
    print(f"{faults} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())

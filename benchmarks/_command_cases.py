"""Command lines run in processes of their own, and whether each ends as it should.

A command that is refused says so in one line and leaves its folder as it was. One that goes on
working is cut: what it computes is the matter of tests.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import pkgutil
import re
import resource
import shlex
import signal
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import numpy as np

from benchmarks._command_lines import line, prepare
from benchmarks._judging import ANOTHER, EQUAL, REFUSED, SLOW, Verdict, seconds_of

CUT_AFTER, HANG_AFTER = 11.0, 25.0
"""Seconds of the processor after which a command is at work, and of the clock without work."""
LARGEST = 300 * 2**20
"""Bytes of a file."""
BROKEN = 99
"""Exit status that stands for a traceback."""
PROGRESS = re.compile(r"^[\w -]+: \d+(/\d+)?\b.*, (\d+ (h|min|s) ?)+(, .* left)?$")
NOTICE = re.compile(r" (is|are) left out: ")
TEMPORARY = re.compile(r"(^|/)\.|checkpoint|\.parts|\.lock|\.tmp")


def preload() -> None:
    """Import all of the package, so that copies of this process need not."""
    import tyro

    import mirror_ppl

    for found in pkgutil.walk_packages(mirror_ppl.__path__, "mirror_ppl."):
        importlib.import_module(found.name)
    del tyro


def judge(sources: Path, seed: int, number: int, keep: Path | None = None) -> Verdict:
    """Run a command line and judge how it ended."""
    del keep  # the command line is all that is needed
    command, arguments = line(np.random.default_rng([seed, 3, number]))
    words = shlex.join([f"mirror_ppl.{command}" if command else "mirror_ppl", *arguments])
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "work"
        prepare(folder, sources)
        before = _content(folder)
        status, seconds, clock = _run(command, arguments, folder, Path(place))
        said, errors = (
            (Path(place) / name).read_text(errors="replace") for name in ("stdout", "stderr")
        )
        after = _content(folder)
        (folder / "locked").chmod(0o700)
    verdict = _judged(command, status, said, errors, before, after)
    if verdict.kind == REFUSED and seconds > SLOW:
        verdict = Verdict("late", verdict.signature, f"after {seconds:.0f} s: {verdict.detail}")
    if status is None and seconds < 1:
        verdict = Verdict("hang", command, f"no work for {clock:.0f} s")
    return Verdict(verdict.kind, verdict.signature, verdict.detail, words, seconds, 0.0)


def _run(
    command: str, arguments: list[str], folder: Path, place: Path
) -> tuple[int | None, float, float]:
    """Exit status, or `None` if it had to be cut; seconds of the processor and of the clock."""
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        _become(command, arguments, folder, place)
    while True:
        ended, status, used = os.wait4(child, os.WNOHANG)
        clock = time.monotonic() - began
        if ended:
            return os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, clock
        seconds = seconds_of(child)
        if seconds > CUT_AFTER or clock > 3 * HANG_AFTER or (clock > HANG_AFTER and seconds < 1):
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None, seconds, clock
        time.sleep(0.05)


def _become(command: str, arguments: list[str], folder: Path, place: Path) -> None:
    """Be the command, in a copy of this process."""
    from mirror_ppl.console import guarded, run

    os.setsid()
    os.chdir(folder)
    os.environ["TMPDIR"] = str(place)
    for name, number in (("stdout", 1), ("stderr", 2)):
        os.dup2(os.open(place / name, os.O_CREAT | os.O_WRONLY), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST, LARGEST))
    status = BROKEN
    # Of a process that is a copy, joblib makes none of its own.
    warnings.filterwarnings("ignore", "Loky-backed parallel loops")
    try:
        module = importlib.import_module(
            f"mirror_ppl.commands.{command}" if command else "mirror_ppl.__main__"
        )
        if command:
            told = {"prog": module.PROGRAM, "description": module.DESCRIPTION, "args": arguments}
            status = run(module.Options, module.main, **told)
        else:
            status = guarded(lambda: module.main(arguments))
    except BaseException:  # noqa: BLE001 - whatever it is, it is a fault
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _judged(
    command: str,
    status: int | None,
    said: str,
    errors: str,
    before: dict[str, str],
    after: dict[str, str],
) -> Verdict:
    changed = sorted(name for name in before.keys() | after if before.get(name) != after.get(name))
    lines = [
        text
        for text in errors.splitlines()
        if text.strip() and not PROGRESS.match(text) and not NOTICE.search(text)
    ]
    detail = "\n".join(lines)
    if status is None:
        return Verdict(ANOTHER, f"{command}: at work")
    if status == BROKEN or "Traceback (most recent call last)" in errors:
        last = lines[-1] if lines else "nothing said"
        frames = [text.strip() for text in lines if "/mirror_ppl/" in text]
        where = re.sub(r'.*/(\w+\.py)", line (\d+).*', r"\1:\2", frames[-1]) if frames else ""
        return Verdict("traceback", f"{last.split(':')[0]} {where}", detail)
    if status == 2:  # noqa: PLR2004 - as documented
        if changed:
            return Verdict("left behind", f"{command}: {_kind(changed[0])}", f"{changed} {detail}")
        if len(lines) == 1 and lines[0].startswith("error: ") and lines[0].isprintable():
            return Verdict(REFUSED, command, detail)
        usual = any(mark in detail for mark in ("Parsing error", "error: unknown", "───", "----"))
        return Verdict(REFUSED if usual else "not one line", f"{command}: usage", detail)
    if status not in ((0, 1) if command in ("calibrate", "evaluate") else (0,)):
        return Verdict("status", f"{command}: {status}", detail)
    failed = [text for text in said.splitlines() if text.startswith("failed: ")]
    if failed:
        return Verdict("failed part", f"{command}: {failed[0][:80]}", "\n".join(failed))
    if status == 0 and lines:
        return Verdict("noise", f"{command}: {lines[-1][:60]}", detail)
    new = [name for name in changed if TEMPORARY.search(name)]
    if new:
        return Verdict("left behind", f"{command}: {_kind(new[0])}", str(new))
    return Verdict(EQUAL, f"{command}: done")


def _kind(name: str) -> str:
    return re.sub(r"[0-9a-f]{8,}", "*", name)


def _content(folder: Path) -> dict[str, str]:
    """What is in a folder: names, and hashes of files."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink() or not path.is_file():
            found[name] = "a link" if path.is_symlink() else "no file"
        else:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found

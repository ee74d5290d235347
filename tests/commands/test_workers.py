"""Processes that share work: they end with the one that started them."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from running import command

from mirror_ppl.commands import calibrate
from mirror_ppl.errors import HumanModelError, MirrorError
from mirror_ppl.user_code import remember_file
from mirror_ppl.workers import run_tasks

MARK = "MIRROR_PPL_TEST_WORKERS"


def square(number):
    return number, number**2


def ends(number):
    raise SystemExit(number)


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_as_tasks_end(jobs):
    found = dict(run_tasks([partial(square, number) for number in range(5)], jobs))
    assert found == {number: number**2 for number in range(5)}


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_task_cannot_end_the_program(jobs):
    with pytest.raises(HumanModelError, match=r"sys.exit\(3\) \(test_workers.py, line"):
        list(run_tasks([partial(ends, 3)], jobs))


def test_a_fault_in_a_users_file_is_one_line(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("def fails():\n    raise RuntimeError('at\\nlast')\n")
    space = {}
    exec(compile(path.read_text(), path, "exec"), space)
    with pytest.raises(RuntimeError):
        list(run_tasks([space["fails"]], 1))
    remember_file(path)
    with pytest.raises(HumanModelError, match=r"^RuntimeError: at last \(mine.py, line 2\)$"):
        list(run_tasks([space["fails"]], 1))


def marked(value):
    """Processes that inherited the mark with this value."""
    found = []
    for process in Path("/proc").iterdir():
        with suppress(OSError):
            if (
                process.name.isdecimal()
                and f"{MARK}={value}\0".encode() in (process / "environ").read_bytes()
            ):
                found.append(int(process.name))
    return found


@pytest.mark.skipif(not os.path.exists("/proc/self/environ"), reason="there is no /proc here")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_workers_end_soon_after_the_process_that_started_them(tmp_path, number):
    code = """
        import signal, sys, time
        from dataclasses import dataclass
        from functools import partial
        from mirror_ppl.console import run
        from mirror_ppl.workers import run_tasks

        @dataclass(frozen=True)
        class Options:
            pass

        def main(options):
            for _ in run_tasks([partial(time.sleep, 0.1), *[partial(time.sleep, 60)] * 2], 2):
                print("at work", flush=True)

        # Whoever runs these tests in the background may have had it ignored.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.exit(run(Options, main, prog="x", description="x", args=[]))
        """
    environment = os.environ | {MARK: str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment,
        text=True,
    ) as process:
        assert process.stdout.readline() == "at work\n"
        assert len(marked(tmp_path)) >= 3
        process.send_signal(number)
        assert process.wait(10) == {9: -9, 15: 143, 2: 130}[number]
        deadline = time.monotonic() + 10
        while marked(tmp_path) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert marked(tmp_path) == []


MODEL = """
from mirror_ppl.models.toy import ToyHuman

calls = 0


class Fails(ToyHuman):
    def act(self, implants, belief, values):
        global calls
        calls += 1
        if implants["in_sight"].shape[-2] > 2:
            raise RuntimeError("later")
        return super().act(implants, belief, values)
"""


@pytest.mark.parametrize("jobs", [1, 2])
def test_calibration_names_the_line_of_a_faulty_model(tmp_path, capsys, jobs):
    (tmp_path / "fails.py").write_text(MODEL)
    model = ("--human-model", f"{tmp_path / 'fails.py'}:Fails", "--out", tmp_path / "out")
    small = ("--people", 10, "--rounds", 1, "--draws", 5, "--jobs", jobs)
    assert command(calibrate, *model, *small) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line == "error: RuntimeError: later (fails.py, line 12)"


def test_a_worker_that_is_killed_is_one_line():
    with pytest.raises(MirrorError, match="its process was killed"):
        list(run_tasks([partial(square, 1), _kill_oneself], 2))


def _kill_oneself():
    os.kill(os.getpid(), signal.SIGKILL)

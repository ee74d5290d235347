"""Processes that share work: they end with the one that started them."""

import os
import signal
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from example_cells import MARK, ends, pair
from running import command

from mirror_ppl.commands import calibrate
from mirror_ppl.errors import HumanModelError
from mirror_ppl.user_code import remember_file
from mirror_ppl.workers import run_tasks


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_as_tasks_end(jobs):
    found = dict(run_tasks([partial(pair, number) for number in range(5)], jobs))
    assert found == {number: number**2 for number in range(5)}


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_task_cannot_end_the_program(jobs):
    with pytest.raises(HumanModelError, match=r"sys.exit\(3\) \(example_cells.py, line"):
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
def test_workers_end_soon_after_the_process_that_started_them(forks, tmp_path, number):
    read, write = os.pipe()
    with open(read) as told:
        with open(write, "w") as out, open(os.devnull, "w") as nowhere:
            process = forks.start("example_cells:at_work", tmp_path, stdout=out, stderr=nowhere)
        assert told.readline() == "at work\n"
        assert len(marked(tmp_path)) >= 2
        os.kill(process, number)
        assert forks.status(process) == {9: -9, 15: 143, 2: 130}[number]
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

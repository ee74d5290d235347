"""Sweeps: every cell once, what is done stays done, what fails does not take the others along."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from mirror_ppl.errors import OptionError
from mirror_ppl.evaluation.sweep import KILLED, run_cells


@dataclass(frozen=True)
class Square:
    number: int

    @property
    def label(self):
        return f"square of {self.number}"


CELLS = [Square(number) for number in (3, 1, 2)]
ASKED = []


def same(cell):
    return "a"


def square(cell):
    ASKED.append(cell.number)
    return [{"number": cell.number, "square": cell.number**2}]


def all_but_one(cell):
    if cell.number == 1:
        raise ValueError("one is no number")
    return square(cell)


@pytest.fixture(autouse=True)
def nothing_asked():
    ASKED.clear()


def squares(outcomes):
    return [row["square"] for outcome in outcomes for row in outcome.rows]


def test_outcomes_come_in_the_order_of_cells_and_progress_is_told(tmp_path):
    told = []
    outcomes = run_cells(
        CELLS, square, tmp_path, same, 1, report=lambda *what: told.append(what), before=told.append
    )
    assert squares(outcomes) == [9, 1, 4]
    assert [outcome.error for outcome in outcomes] == [None] * 3
    assert told == [
        0,
        (1, "square of 3"),
        (2, "square of 1"),
        (3, "square of 2"),
    ]


def test_what_is_done_is_not_done_again(tmp_path):
    run_cells(CELLS[:2], square, tmp_path, same, 1)
    told = []
    outcomes = run_cells(
        CELLS, square, tmp_path, same, 1, report=lambda *what: told.append(what), before=told.append
    )
    assert squares(outcomes) == [9, 1, 4]
    assert ASKED == [3, 1, 2]
    assert told == [2, (3, "square of 2")]


def test_what_depends_on_something_else_is_done_again(tmp_path):
    run_cells(CELLS, square, tmp_path, same, 1)
    run_cells(CELLS, square, tmp_path, lambda cell: "b" if cell.number == 1 else "a", 1)
    assert ASKED == [3, 1, 2, 1]


def test_a_damaged_result_is_made_anew(tmp_path):
    run_cells(CELLS[:1], square, tmp_path, same, 1)
    (file,) = tmp_path.iterdir()
    whole = file.read_text()
    for content in (whole[:20], json.dumps([1]), ""):
        file.write_text(content)
        assert squares(run_cells(CELLS[:1], square, tmp_path, same, 1)) == [9]
        assert json.loads(file.read_text())["rows"] == [{"number": 3, "square": 9}]


def test_a_failure_is_told_loses_nothing_and_is_tried_again(tmp_path):
    outcomes = run_cells(CELLS, all_but_one, tmp_path, same, 1)
    assert squares(outcomes) == [9, 4]
    error = outcomes[1].error
    assert error is not None
    assert error.startswith("ValueError: one is no number (test_sweep.py, line ")
    assert squares(run_cells(CELLS, square, tmp_path, same, 1)) == [9, 1, 4]
    assert ASKED == [3, 2, 1]


def die_of_one(cell):
    if cell.number == 1:
        os._exit(3)
    return square(cell)


def test_who_kills_their_process_is_told_and_the_others_are_done(tmp_path):
    outcomes = run_cells(CELLS, die_of_one, tmp_path, same, 2)
    assert squares(outcomes) == [9, 4]
    assert outcomes[1].error == KILLED
    assert len(list(tmp_path.iterdir())) == 2


def test_processes_beside_each_other_find_the_same(tmp_path):
    assert squares(run_cells(CELLS, square, tmp_path, same, 2)) == [9, 1, 4]
    assert ASKED == []  # other processes did it
    assert len(list(tmp_path.iterdir())) == 3


def test_a_cluster_that_is_not_there_is_told(tmp_path):
    from dask.base import get_scheduler

    with pytest.raises(OptionError) as error:
        run_cells(CELLS, square, tmp_path, same, scheduler="not an address")
    assert str(error.value).startswith("--scheduler not an address cannot be reached: ")
    assert get_scheduler() is None  # or whatever is written next asks that cluster for its lock


CLUSTER = """
import sys
from pathlib import Path
from distributed import LocalCluster
sys.path.insert(0, "{tests}")
from mirror_ppl.evaluation.sweep import run_cells
from test_sweep import CELLS, same, square, squares

if __name__ == "__main__":
    options = dict(n_workers=1, threads_per_worker=1, dashboard_address=None)
    with LocalCluster(**options) as cluster:
        found = run_cells(CELLS, square, Path("{out}"), same, scheduler=cluster.scheduler_address)
    print(squares(found))
"""


@pytest.mark.slow
def test_a_cluster_does_the_same(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    script = tmp_path / "script.py"
    script.write_text(CLUSTER.format(tests=Path(__file__).parent, out=out))
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.stdout.strip() == "[9, 1, 4]", done.stderr
    assert len(list(out.iterdir())) == 3

"""Cells of work: each is done once, finished ones are kept, and a failure loses no other."""

import json
import os
from dataclasses import dataclass

import numpy as np
import pytest
import xarray as xr
from example_cells import ASKED, FOLDER, Square, die_of_one, die_once, square

from mirror_ppl.errors import OptionError, WorkerError
from mirror_ppl.jobs import DatasetFormat, JsonFormat, Runner
from mirror_ppl.progress import Progress
from mirror_ppl.workers import KILLED

CELLS = [Square(number) for number in (3, 1, 2)]


def same(cell):
    return "a"


def all_but_one(cell):
    if cell.number == 1:
        raise ValueError("one is no number")
    return square(cell)


@pytest.fixture(autouse=True)
def nothing_asked():
    ASKED.clear()


def squares(outcomes):
    return [row["square"] for outcome in outcomes for row in outcome.result or ()]


class Noted(Progress):
    """Progress that notes what it is told."""

    def __init__(self):
        super().__init__("squares", quiet=True)
        self.notes = []

    def resume(self, done):
        super().resume(done)
        self.notes.append(done)

    def update(self, done, message=""):
        super().update(done, message)
        self.notes.append((done, message))


def test_outcomes_come_in_the_order_of_cells_and_progress_is_reported(tmp_path):
    progress = Noted()
    outcomes = Runner(tmp_path, same, progress=progress).run(CELLS, square)
    assert squares(outcomes) == [9, 1, 4]
    assert [outcome.error for outcome in outcomes] == [None] * 3
    assert progress.notes == [0, (1, "square of 3"), (2, "square of 1"), (3, "square of 2")]


def test_what_is_done_is_not_done_again(tmp_path):
    Runner(tmp_path, same).run(CELLS[:2], square)
    progress = Noted()
    outcomes = Runner(tmp_path, same, progress=progress).run(CELLS, square)
    assert squares(outcomes) == [9, 1, 4]
    assert ASKED == [3, 1, 2]
    assert progress.notes == [2, (3, "square of 2")]


def test_without_a_folder_nothing_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        runner = Runner()
        assert squares(runner.run(CELLS[:1], square)) == [9]
        runner.clean()
    assert ASKED == [3, 3]
    assert list(tmp_path.iterdir()) == []


def test_what_depends_on_something_else_is_done_again(tmp_path):
    Runner(tmp_path, same).run(CELLS, square)
    Runner(tmp_path, lambda cell: "b" if cell.number == 1 else "a").run(CELLS, square)
    assert ASKED == [3, 1, 2, 1]


def test_a_damaged_result_is_made_anew(tmp_path):
    Runner(tmp_path, same).run(CELLS[:1], square)
    (file,) = tmp_path.iterdir()
    whole = file.read_text()
    for content in (whole[:20], json.dumps([1]), ""):
        file.write_text(content)
        assert squares(Runner(tmp_path, same).run(CELLS[:1], square)) == [9]
        assert json.loads(file.read_text())["result"] == [{"number": 3, "square": 9}]


def test_a_failure_is_reported_loses_nothing_and_is_tried_again(tmp_path):
    outcomes = Runner(tmp_path, same, keep_going=True).run(CELLS, all_but_one)
    assert squares(outcomes) == [9, 4]
    error = outcomes[1].error
    assert error is not None
    assert error.startswith("ValueError: one is no number (test_jobs.py, line ")
    assert squares(Runner(tmp_path, same).run(CELLS, square)) == [9, 1, 4]
    assert ASKED == [3, 2, 1]


def test_work_that_kills_its_process_is_reported_and_the_rest_is_done(tmp_path):
    outcomes = Runner(tmp_path, same, 2, keep_going=True).run(CELLS, die_of_one)
    assert squares(outcomes) == [9, 4]
    assert outcomes[1].error == KILLED
    assert len(list(tmp_path.iterdir())) == 2


def test_work_that_needs_all_cells_ends_with_the_failure_and_keeps_what_is_done(tmp_path):
    with pytest.raises(ValueError, match="one is no number"):
        Runner(tmp_path, same).run(CELLS, all_but_one)
    assert ASKED == [3]
    assert squares(Runner(tmp_path, same).run(CELLS, square)) == [9, 1, 4]
    assert ASKED == [3, 1, 2]


def test_work_that_needs_all_cells_names_the_one_that_kills_its_process(tmp_path):
    with pytest.raises(WorkerError, match=f"^square of 1: {KILLED}"):
        Runner(tmp_path, same, 2).run(CELLS, die_of_one)


LIMIT = 20


def test_who_is_killed_once_is_tried_again_and_the_rest_is_done_beside_each_other(
    tmp_path, monkeypatch
):
    """Only cells that were handed out when the process was killed are done one at a time."""
    monkeypatch.setenv(FOLDER, str(tmp_path))
    cells = [Square(number) for number in range(1, LIMIT + 1)]
    outcomes = Runner(None, same, 2).run(cells, die_once)
    found = squares(outcomes)
    assert found[::2] == [number**2 for number in range(1, LIMIT + 1)]
    assert (tmp_path / "died-1").exists()
    assert os.getpid() not in found[1::2]


def test_a_dataset_is_read_as_it_was_written_and_a_damaged_one_is_made_anew(tmp_path):
    data = xr.Dataset({"square": ("number", [1.0, np.inf])}, attrs={"draws": 3})
    done = []

    def work(cell):
        done.append(cell)
        return data

    def run():
        (outcome,) = Runner(tmp_path, same).run(CELLS[:1], work, DatasetFormat())
        xr.testing.assert_identical(outcome.result, data)
        return len(done)

    assert [run(), run()] == [1, 1]
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:100])
    assert run() == 2


@dataclass(frozen=True)
class Point:
    x: float


def test_dataclasses_are_decoded(tmp_path):
    form = JsonFormat(lambda content: Point(**content))
    for _ in range(2):
        (outcome,) = Runner(tmp_path, same).run(CELLS[:1], lambda cell: Point(cell.number), form)
        assert outcome.result == Point(3)


def test_only_results_of_cells_are_cleaned_away(tmp_path):
    folder = tmp_path / "parts"
    folder.mkdir()
    runner = Runner(folder, same)
    runner.run(CELLS, square)
    (folder / "notes.json").write_text("{}")
    runner.clean()
    assert [path.name for path in folder.iterdir()] == ["notes.json"]
    (folder / "notes.json").unlink()
    runner.clean()
    assert not folder.exists()


def test_processes_beside_each_other_find_the_same(tmp_path):
    assert squares(Runner(tmp_path, same, 2).run(CELLS, square)) == [9, 1, 4]
    assert ASKED == []  # other processes did it
    assert len(list(tmp_path.iterdir())) == 3


def test_a_missing_cluster_is_reported(tmp_path):
    from dask.base import get_scheduler

    with pytest.raises(OptionError) as error:
        Runner(tmp_path, same, scheduler="not an address").run(CELLS, square)
    assert str(error.value).startswith("--scheduler not an address cannot be reached: ")
    assert get_scheduler() is None  # or whatever is written next asks that cluster for its lock


def test_a_cluster_does_the_same(cluster, tmp_path):
    assert squares(Runner(tmp_path, same, scheduler=cluster).run(CELLS, square)) == [9, 1, 4]
    assert ASKED == []  # another process did it
    assert len(list(tmp_path.iterdir())) == 3

"""Files: written whole or not at all, by one process at a time; read only if they are files."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from mirror_ppl.checkpoints import read_checkpoint, save_checkpoint
from mirror_ppl.errors import CheckpointError, OptionError, OutputError
from mirror_ppl.files import (
    LOCK,
    PARTIAL,
    json_text,
    lock_of,
    output_folder,
    read_whole,
    write_together,
    write_whole,
)


def content(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def python(code, *args, **options):
    """A process that runs this code."""
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code), *map(str, args)],
        stdout=subprocess.PIPE,
        text=True,
        **options,
    )


@pytest.fixture
def full(monkeypatch):
    """A disk that takes the first few bytes of a file, and is full then."""

    def sync(number):
        if os.fstat(number).st_size > 10:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", sync)


# --- writing ------------------------------------------------------------------------------------


def test_write_whole_writes_and_replaces(tmp_path):
    path = tmp_path / "new" / "deep" / "a.txt"
    assert write_whole(path, "one") == path
    assert path.read_text() == "one"
    write_whole(str(path), b"two")
    assert path.read_text() == "two"
    assert content(path.parent) == ["a.txt"]


def test_write_whole_gives_the_permissions_of_any_new_file(tmp_path):
    (tmp_path / "plain").touch()
    write_whole(tmp_path / "whole", "x")
    assert (tmp_path / "whole").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_write_whole_takes_the_longest_names(tmp_path):
    name = "n" * 251 + ".txt"
    write_whole(tmp_path / name, "x")
    assert content(tmp_path) == [name]


@pytest.mark.parametrize("failure", [ZeroDivisionError, KeyboardInterrupt, OSError])
def test_a_failure_leaves_old_files_and_nothing_new(tmp_path, monkeypatch, failure):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def sync(number):
        assert path.read_text() == "old"
        raise failure("no space")

    monkeypatch.setattr("os.fsync", sync)
    raised = OutputError if failure is OSError else failure
    with pytest.raises(raised, match="no space"):
        write_whole(path, "new")
    with pytest.raises(raised, match="no space"):
        write_whole(tmp_path / "new" / "deep" / "a.txt", "new")
    assert content(tmp_path) == ["a.txt"]
    assert path.read_text() == "old"


@pytest.mark.parametrize("where", ["new", "new/deep"])
def test_an_interruption_just_after_a_folder_was_made_leaves_none(tmp_path, monkeypatch, where):
    mkdir = Path.mkdir

    def interrupted(path):
        mkdir(path)
        if path == tmp_path / where:
            raise KeyboardInterrupt

    monkeypatch.setattr(Path, "mkdir", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "new" / "deep" / "a.txt", "new")
    with pytest.raises(KeyboardInterrupt), output_folder(tmp_path / "new" / "deep", ["a.txt"]):
        raise AssertionError("the folder was not reached")
    assert content(tmp_path) == []


def test_files_are_written_together_or_not_at_all(tmp_path, full):
    small, large, stale = (tmp_path / name for name in ("small", "large", "stale"))
    small.write_text("old")
    stale.write_text("stale")
    with pytest.raises(OutputError, match=r"cannot write .*large: No space left on device"):
        write_together({small: "new", large: "much too long"}, remove=[stale])
    assert content(tmp_path) == ["small", "stale"]
    assert small.read_text() == "old"
    write_together({small: "new", large: "short"}, remove=[stale])
    assert content(tmp_path) == ["large", "small"]


def test_write_whole_killed_half_way_keeps_the_old_content(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    code = """
        import os, sys
        from mirror_ppl.files import write_whole

        os.fsync = lambda number: os._exit(9)
        write_whole(sys.argv[1], "new")
        """
    with python(code, path) as process:
        assert process.wait() == 9
    assert path.read_text() == "old"
    assert len(content(tmp_path)) == 2
    with output_folder(tmp_path):
        assert content(tmp_path) == [LOCK, "a.txt"]
    assert content(tmp_path) == ["a.txt"]


def test_files_that_another_process_is_writing_are_not_removed(tmp_path):
    code = """
        import os, sys, time
        from mirror_ppl.files import write_whole

        def wait(number):
            print("writing", flush=True)
            time.sleep(60)

        os.fsync = wait
        write_whole(sys.argv[1], "new")
        """
    with python(code, tmp_path / "a.txt") as process:
        process.stdout.readline()
        with output_folder(tmp_path):
            (partial,) = tmp_path.glob(f".*{PARTIAL}")
        process.kill()
    with output_folder(tmp_path):
        assert not partial.exists()


def test_write_whole_follows_a_link(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "a.txt").symlink_to("elsewhere/b.txt")
    write_whole(tmp_path / "a.txt", "x")
    assert (tmp_path / "a.txt").is_symlink()
    assert (tmp_path / "elsewhere" / "b.txt").read_text() == "x"


def in_folder(path):
    with output_folder(path):
        pytest.fail("nothing is done in it")


@pytest.mark.parametrize("where", [".", "pipe"])
def test_what_is_no_regular_file_is_not_replaced(tmp_path, where):
    os.mkfifo(tmp_path / "pipe")
    for call in (
        lambda: write_whole(tmp_path / where, "x"),
        lambda: output_folder(tmp_path, [where]).__enter__(),
    ):
        with pytest.raises(OutputError, match="not a regular file"):
            call()
    assert content(tmp_path) == ["pipe"]


@pytest.mark.parametrize("call", [in_folder, lambda to: write_whole(to, "x")])
def test_a_file_in_the_way_is_an_output_error(tmp_path, call):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match=r"cannot create the folder .*file"):
        call(tmp_path / "file" / "sub" / "deep")
    with pytest.raises(OutputError, match="null"):
        call(tmp_path / "a\0b" / "c")
    assert content(tmp_path) == ["file"]


# --- folders of results -------------------------------------------------------------------------


def test_an_output_folder_is_created_and_left_empty(tmp_path):
    folder = tmp_path / "runs" / "demo"
    for _ in range(2):
        with output_folder(str(folder)) as found:
            assert found == folder
        assert content(tmp_path) == ["runs", "runs/demo"]


def test_an_output_folder_is_removed_if_the_work_fails(tmp_path):
    with pytest.raises(OptionError), output_folder(tmp_path / "runs" / "demo"):
        raise OptionError("no")
    assert content(tmp_path) == []
    with pytest.raises(OptionError), output_folder(tmp_path / "runs" / "demo") as folder:
        (folder / "checkpoint").touch()
        raise OptionError("no")
    assert content(tmp_path) == ["runs", "runs/demo", "runs/demo/checkpoint"]


def test_a_folder_that_cannot_be_written(tmp_path, monkeypatch):
    # Root may write anywhere, so the refusal is staged.
    def refuse(self, *args, **kwargs):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr("pathlib.Path.open", refuse)
    with pytest.raises(OutputError, match=r"cannot write in .*demo.*Permission denied"):
        in_folder(tmp_path / "runs" / "demo")
    with pytest.raises(OutputError, match=r"cannot write .*Permission denied"):
        write_whole(tmp_path / "runs" / "a.txt", "x")
    assert content(tmp_path) == []


HOLD = """
    import sys, time
    from mirror_ppl.files import output_folder

    with output_folder(sys.argv[1], lock=sys.argv[2]):
        print("at work", flush=True)
        time.sleep(60)
    """


@pytest.mark.parametrize("lock", [LOCK, lock_of(Path("a.nc"))])
def test_a_second_process_is_refused_as_long_as_the_first_lives(tmp_path, lock):
    with python(HOLD, tmp_path, lock) as process:
        process.stdout.readline()
        named = tmp_path if lock == LOCK else tmp_path / "a.nc"
        with (
            pytest.raises(OutputError, match=f"^{named} is being written by process {process.pid}"),
            output_folder(tmp_path, lock=lock),
        ):
            pytest.fail("both are at work")
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert content(tmp_path) == [lock]
        with output_folder(tmp_path, lock=lock):
            assert str(os.getpid()) in (tmp_path / lock).read_text()
    assert content(tmp_path) == []


# --- reading ------------------------------------------------------------------------------------


def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, message in (
        (tmp_path / "pipe", "is not a regular file"),
        ("/dev/zero", "is not a regular file"),
        (tmp_path, "is not a regular file"),
        (tmp_path / "none", "there is no such file"),
        ("a\0b", "cannot be read"),
    ):
        began = time.monotonic()
        with pytest.raises(OptionError, match=message):
            read_whole(path, OptionError)
        assert time.monotonic() - began < 5
    (tmp_path / "file").write_bytes(b"all of it")
    assert read_whole(tmp_path / "file", OptionError) == b"all of it"


def test_json_is_strict():
    given = {"a": float("nan"), "b": [np.float64("inf"), 1.5, None], "c": (1, "x")}
    assert json.loads(json_text(given)) == {"a": None, "b": [None, 1.5, None], "c": [1, "x"]}


def test_a_checkpoint_with_any_byte_changed_is_refused(tmp_path, rng):
    path = tmp_path / "a.checkpoint"
    save_checkpoint(path, "run", {"numbers": [1.0, 2.0]})
    assert read_checkpoint(path, "run")["numbers"] == [1.0, 2.0]
    whole = path.read_bytes()
    for place in rng.integers(len(whole), size=50):
        damaged = bytearray(whole)
        damaged[place] ^= 4
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match="not a checkpoint"):
            read_checkpoint(path, "run")
    path.write_bytes(whole)
    with pytest.raises(CheckpointError, match="belongs to a run with other options"):
        read_checkpoint(path, "another")

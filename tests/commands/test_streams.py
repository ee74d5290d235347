"""Streams that end, are full, closed or narrow, and signals: a quiet end, results whole."""

import os
import shlex
import signal
import subprocess
import sys
import time

import pytest

from mirror_ppl.data import asset_path, load_demonstrations

SIMULATE = "mirror_ppl.simulate", "--people", 1, "--rounds", 1, "--out"
CARD = "mirror_ppl.train", "--card"


def whole(path):
    """Whether recordings are there, and nothing else."""
    load_demonstrations(path)
    return list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("what", ["lines", "tables"])
def test_a_reader_that_goes_away(forks, tmp_path, what):
    path = tmp_path / "x.nc"
    command = (
        (*SIMULATE, path) if what == "lines" else (*CARD, asset_path("driving_guide.safetensors"))
    )
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as pipe:
        done = forks.run(*command, stdout=pipe)
    assert done.returncode == 141
    assert not any(word in done.stderr for word in ("Traceback", "error", "ignored"))
    assert what == "tables" or whole(path)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full here")
def test_streams_that_are_full(forks, tmp_path):
    first, second = tmp_path / "a" / "x.nc", tmp_path / "b" / "x.nc"
    with open("/dev/full", "w") as full:
        done = forks.run(*SIMULATE, first, stdout=full)
        assert done.returncode == 2
        assert done.stderr.splitlines()[-1] == "error: cannot write: No space left on device"
        assert "Traceback" not in done.stderr and "ignored" not in done.stderr
        done = forks.run(*SIMULATE, second, stderr=full)
        assert done.returncode == 0
    assert whole(first) and whole(second)


def test_streams_that_are_closed(tmp_path):
    """From the interpreter's start, which makes none then."""
    path = tmp_path / "x.nc"
    words = shlex.join([sys.executable, "-m", *map(str, SIMULATE), str(path)])
    assert (
        subprocess.run(["sh", "-c", f"{words} >&- 2>&-"], timeout=120, check=False).returncode == 0
    )
    assert whole(path)


def test_streams_that_are_ascii(forks, tmp_path):
    path = tmp_path / "\N{HEBREW LETTER ALEF}.nc"
    done = forks.run(*SIMULATE, path, encoding="ascii")
    assert done.returncode == 0
    assert "\\u05d0.nc: driving, fog" in done.stdout
    assert whole(path)


@pytest.mark.parametrize(
    ("number", "status", "line"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")],
)
def test_signals_end_work_at_once_and_leave_nothing(forks, tmp_path, number, status, line):
    out, said = tmp_path / "out", tmp_path / "said"
    command = "mirror_ppl.fit", "--guide", "svi", "--steps", 100000, "--out", out
    with said.open("w") as stream, open(os.devnull, "w") as nowhere:
        process = forks.start(*command, stdout=nowhere, stderr=stream)
    deadline = time.monotonic() + 60
    while not out.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    os.kill(process, number)
    began = time.monotonic()
    assert forks.status(process) == status
    assert time.monotonic() - began < 10  # seconds; three where nothing else runs
    assert said.read_text().splitlines()[-1] == line
    assert not out.exists()

"""Streams that end, are full, closed or narrow, and signals: a quiet end, results whole."""

import os
import signal
import subprocess
import sys
import time

import pytest

from mirror_ppl.data import asset_path, load_demonstrations

SIMULATE = [sys.executable, "-m", "mirror_ppl.simulate", "--people", "1", "--rounds", "1", "--out"]
CARD = [sys.executable, "-m", "mirror_ppl.train", "--card"]


def run(command, **options):
    return subprocess.run(command, check=False, timeout=120, **options)


def whole(path):
    """Whether recordings are there, and nothing else."""
    load_demonstrations(path)
    return list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("what", ["lines", "tables"])
def test_a_reader_that_goes_away(tmp_path, what):
    path = tmp_path / "x.nc"
    command = (
        [*SIMULATE, path] if what == "lines" else [*CARD, asset_path("driving_guide.safetensors")]
    )
    read, write = os.pipe()
    os.close(read)
    try:
        done = run(command, stdout=write, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(write)
    assert done.returncode == 141
    assert not any(word in done.stderr for word in ("Traceback", "error", "ignored"))
    assert what == "tables" or whole(path)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full here")
def test_streams_that_are_full(tmp_path):
    first, second = tmp_path / "a" / "x.nc", tmp_path / "b" / "x.nc"
    with open("/dev/full", "w") as full:
        done = run([*SIMULATE, first], stdout=full, stderr=subprocess.PIPE, text=True)
        assert done.returncode == 2
        assert done.stderr.splitlines()[-1] == "error: cannot write: No space left on device"
        assert "Traceback" not in done.stderr and "ignored" not in done.stderr
        done = run([*SIMULATE, second], stdout=subprocess.PIPE, stderr=full)
        assert done.returncode == 0
    assert whole(first) and whole(second)


def test_streams_that_are_closed(tmp_path):
    path = tmp_path / "x.nc"
    assert run(["sh", "-c", f"{' '.join(SIMULATE)} {path} >&- 2>&-"]).returncode == 0
    assert whole(path)


def test_streams_that_are_ascii(tmp_path):
    narrow = {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    path = tmp_path / "\N{HEBREW LETTER ALEF}.nc"
    done = run([*SIMULATE, path], capture_output=True, env=os.environ | narrow)
    assert done.returncode == 0
    assert b"\\u05d0.nc: driving, fog" in done.stdout
    assert whole(path)


@pytest.mark.parametrize(
    ("number", "status", "line"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")],
)
def test_signals_end_work_at_once_and_leave_nothing(request, tmp_path, number, status, line):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "mirror_ppl.fit", "--guide", "svi", "--steps", "100000"]
    # A background job ignores interruptions, and so would the processes that it starts.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    with subprocess.Popen(
        [*command, "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        deadline = time.monotonic() + 60
        while not out.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        process.send_signal(number)
        began = time.monotonic()
        assert process.wait(30) == status
        assert time.monotonic() - began < 10  # seconds; three where nothing else runs
        assert process.stderr.read().splitlines()[-1] == line
    assert not out.exists()

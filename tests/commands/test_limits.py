"""Numbers without an end, and memory that there is not, are refused before any work."""

from types import SimpleNamespace

import pytest
from running import command

from mirror_ppl import limits
from mirror_ppl.commands import assist, calibrate, compare, evaluate, fit, simulate, train
from mirror_ppl.errors import OptionError
from mirror_ppl.limits import LIMITS, free_memory, require_memory, return_memory, share

HUGE = [
    (fit, "--draws", 99999999999, "at most 100000"),
    (fit, "--explore", 999999999, "at most 1000"),
    (fit, "--steps", 10**12, "at most 1000000"),
    (fit, "--refine", 10**12, "at most 1000000"),
    (simulate, "--people", 9999999999, "at most 1000000"),
    (simulate, "--rounds", 10**8, "at most 10000"),
    (assist, "--horizon", 10**6, "at most 1000"),
    (assist, "--jobs", -1, "at least 1"),
    (calibrate, "--people", 10**9, "at most 1000000"),
    (calibrate, "--jobs", -2, "at least -1"),
    (evaluate, "--seeds", 10**9, "at most 10000"),
    (train, "--phases", 10**9, "at most 100000"),
    (train, "--learning-rate", 1e30, "above 0 and at most 1"),
    (train, "--learning-rate", "nan", "above 0 and at most 1"),
]
SEEDS = [fit, simulate, assist, calibrate, train]


def refused(capsys, tmp_path, module, *args):
    """The one line of an argument error, which leaves nothing behind."""
    required = {simulate: ("--out", tmp_path / "x.nc"), evaluate: ("prediction",)}
    assert command(module, *required.get(module, ()), *args) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("error: ") and said.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
    return said.err


@pytest.mark.parametrize(("module", "option", "value", "message"), HUGE)
def test_numbers_without_an_end_are_refused(tmp_path, capsys, module, option, value, message):
    line = refused(capsys, tmp_path, module, f"{option}={value}")
    assert f"{option} must be {message}, not " in line


@pytest.mark.parametrize("module", SEEDS)
@pytest.mark.parametrize(
    ("value", "message"),
    [(-1, "at least 0"), (2**32, "at most 4294967295"), (2**64, "at most 4294967295")],
)
def test_one_rule_for_seeds(tmp_path, capsys, module, value, message):
    line = refused(capsys, tmp_path, module, f"--seed={value}")
    assert line == f"error: --seed must be {message}, not {value}\n"


def test_the_largest_seed_makes_recordings(tmp_path):
    args = ("--people", 1, "--rounds", 1, "--seed", LIMITS["seed"][1])
    assert command(simulate, "--out", tmp_path / "x.nc", *args) == 0


@pytest.mark.parametrize("device", ["meta", "cuda:99", "", "cpu:1"])
def test_devices_that_cannot_compute_are_refused(tmp_path, capsys, device):
    assert "unknown device" in refused(capsys, tmp_path, simulate, f"--device={device}")


def test_recordings_that_do_not_fit_into_memory_are_refused(tmp_path, capsys):
    args = ("--people", 1_000_000, "--rounds", 10_000, "--domain", "bomb_defusal")
    assert "GB of memory" in refused(capsys, tmp_path, simulate, *args)


def test_draws_that_do_not_fit_into_memory_are_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(limits, "free_memory", lambda: 2**27)
    options = ("--draws", 10_000, "--jobs", 2, "--out", tmp_path / "out")
    line = refused(capsys, tmp_path, fit, *options)
    assert "so many draws of predictions would need about 0.6 " in line
    assert line.endswith("GB of memory, 0.1 GB are free\n")


def test_what_fits_is_not_refused(monkeypatch):
    require_memory(1000, "little")
    monkeypatch.setattr(limits, "free_memory", lambda: None)  # where nobody knows
    require_memory(2**60, "much")
    monkeypatch.undo()
    free = free_memory()
    assert free is None or 2**20 < free < 2**50


@pytest.mark.parametrize(
    ("text", "value"), [("0%", 0), ("2.5%", 0.025), ("100%", 1), ("0", 0), (" 3 % ", 0.03)]
)
def test_shares(text, value):
    assert share(text, "--share") == value


@pytest.mark.parametrize("text", ["", "%", "nan", "0.04", "4", "-1%", "101%", "inf", "a"])
def test_what_is_no_share(text):
    with pytest.raises(OptionError, match="--share must be from 0% to 100%, such as 2.5%, not "):
        share(text, "--share")


@pytest.mark.parametrize(
    ("module", "args", "line"),
    [
        (fit, ("--drws", "3"), "Unrecognized options: --drws, 3; perhaps you meant --draws"),
        (fit, ("--draws", "x"), "--draws must be a whole number, not x"),
        (fit, ("--train-rounds", "2.5"), "--train-rounds must be a whole number, not 2.5"),
        (assist, ("--posterior", "a.nc", "--discount", "1/2"), "--discount must be a number, not"),
        (fit, ("more",), "Unrecognized options: more"),
        (fit, ("--demos",), "Missing value for argument '--demos'"),
        (compare, (), "give at least two posteriors to compare, not 0"),
        (evaluate, ("all",), "invalid choice 'all' for argument 'study'"),
    ],
)
def test_argument_errors_are_one_line(tmp_path, capsys, module, args, line):
    assert command(module, *args) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"error: {line}") and said.err.count("\n") == 1
    assert "│" not in said.err
    if module is not compare:
        assert said.err.endswith(f"; see {module.PROGRAM} --help\n")


def test_freed_memory_is_returned_where_the_system_can(monkeypatch):
    called = []
    library = SimpleNamespace(malloc_trim=called.append)
    for found in (library, SimpleNamespace()):
        monkeypatch.setattr("ctypes.CDLL", lambda name, found=found: found)
        return_memory()
    assert called == [0]

    def missing(name):
        raise OSError(f"no library {name}")

    monkeypatch.setattr("ctypes.CDLL", missing)
    return_memory()
    monkeypatch.undo()
    return_memory()

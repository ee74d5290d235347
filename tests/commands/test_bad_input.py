"""Bad input of the commands, refused in one line and without a trace."""

import math
import sys

import pytest
from example_fits import content, two_people
from running import command

from mirror_ppl.commands import assist, fit, simulate, train
from mirror_ppl.data import save_demonstrations, to_dataset


@pytest.fixture(scope="module")
def some():
    return two_people()


@pytest.fixture(scope="module")
def folder(some, tmp_path_factory):
    """A folder with recordings."""
    folder = tmp_path_factory.mktemp("recordings")
    save_demonstrations(folder / "some.nc", some)
    return folder


def broken(some, path, change):
    """Recordings like ``some``, but for a change that `Demonstrations` would not allow."""
    dataset = to_dataset(some)
    changed = change(dataset)
    (dataset if changed is None else changed).to_netcdf(path, engine="h5netcdf")


def put(name, index, value):
    def change(dataset):
        values = dataset[name].values.astype(float)
        values[index] = value
        dataset[name] = (dataset[name].dims, values)

    return change


BROKEN = {
    "wrong shape": (lambda data: data.isel(time=slice(0, 5)), "ego has shape"),
    "missing variable": (lambda data: data.drop_vars("visual"), "variable visual is missing"),
    "nan": (
        put("visual", (1, 2, 5, 0, 0), math.nan),
        "visual of front-left, distance_ahead is nan",
    ),
    "action too high": (put("action", (0, 3, 4), 2), "action is 2, expected a whole number from 0"),
    "action too low": (put("action", (0, 3, 4), -1), "action is -1, expected a whole number"),
    "no steps": (put("length", (1, 0), 0), "length is 0, expected at least 1"),
    "unknown domain": (lambda data: data.assign_attrs(domain="flying"), 'unknown domain "flying"'),
    "other format": (lambda data: data.assign_attrs(format="csv"), "attribute format is 'csv'"),
}


def refused(capsys, folder, module, *args):
    """Run a command that must be refused in one line, without writing; the line."""
    before = content(folder)
    capsys.readouterr()
    assert command(module, *args) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    assert content(folder) == before
    return captured.err


@pytest.mark.parametrize("kind", BROKEN)
def test_recordings_with_a_fault_are_refused(some, tmp_path, capsys, kind):
    change, message = BROKEN[kind]
    broken(some, tmp_path / "bad.nc", change)
    args = "--demos", tmp_path / "bad.nc", "--out", tmp_path / "out"
    line = refused(capsys, tmp_path, fit, *args)
    assert "bad.nc: " in line
    assert message in line


def test_recordings_that_cannot_be_read_are_refused(folder, tmp_path, capsys):
    whole = (folder / "some.nc").read_bytes()
    (tmp_path / "truncated.nc").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.nc").write_text("person,action\n")
    (tmp_path / "empty.nc").touch()
    for name, message in {
        "missing.nc": "there is no such file",
        "truncated.nc": "truncated or damaged",
        "text.nc": "not a netCDF file",
        "empty.nc": "not a netCDF file",
        ".": "is not a regular file",
    }.items():
        args = "--demos", tmp_path / name, "--out", tmp_path / "out"
        assert message in refused(capsys, tmp_path, fit, *args)


HUMAN = """
from mirror_ppl.models import HumanModel

class NoHuman:
    pass

class Numb(HumanModel):
    def act(self, implants, belief, values):
        return values

class Dreamer(HumanModel):
    def perceive(self, implants, knowledge, observation, told, step):
        sites = {**implants, "told": implants["lapse"]}
        return super().perceive(sites, knowledge, observation, told, step)
"""


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (
            ("--domain", "flying"),
            'unknown domain "flying"; known: bomb_defusal, driving, highway, search_rescue',
        ),
        (("--setting", "rain"), 'unknown setting "rain" in driving; known: clear, fog'),
        (("--population", "dense"), 'unknown population "dense" in driving; known: diverse, paper'),
        (("--device", "abacus"), 'unknown device "abacus"; known: cpu'),
        (("--demos", "some.nc", "--train-rounds", "5"), "cannot train on 5 of 4 rounds"),
        (("--self-model", "nowhere"), "nowhere: there is no such file"),
        (("--self-model", "some.nc"), "some.nc: cannot be read as weights"),
        (("--human-model", "mine.py"), "not of the form path/to/file.py:Class"),
        (("--human-model", "nowhere.py:Mine"), "nowhere.py: there is no such file"),
        (("--human-model", "broken.py:Mine"), "broken.py does not import: SyntaxError"),
        (("--human-model", "needs.py:Mine"), "No module named 'nonesuch' (needs.py, line 1)"),
        (("--human-model", "mine.py:Mine"), "no class Mine derived from"),
        (("--human-model", "mine.py:NoHuman"), "it has: Numb, Dreamer"),
        (("--human-model", "mine.py:Numb"), "they do not sum to 1"),
        (
            ("--human-model", "mine.py:Dreamer"),
            "act() reads a site that perceive() reads, too (lapse)",
        ),
        (("--out", "some.nc/out"), "cannot create the folder some.nc/out: Not a directory"),
        (("--out", "some.nc"), "cannot create the folder some.nc: Not a directory"),
    ],
)
def test_fit_refuses_what_cannot_be_done(folder, tmp_path, monkeypatch, capsys, args, message):
    (tmp_path / "some.nc").write_bytes((folder / "some.nc").read_bytes())
    (tmp_path / "mine.py").write_text(HUMAN)
    (tmp_path / "broken.py").write_text("class Mine(:\n")
    (tmp_path / "needs.py").write_text("import nonesuch\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    out = () if "--out" in args else ("--out", "out")
    assert message in refused(capsys, tmp_path, fit, *out, *args)


def test_fit_refuses_a_checkpoint_of_something_else(folder, tmp_path, capsys):
    (tmp_path / "fit.checkpoint").write_bytes(b"nonsense")
    args = "--demos", folder / "some.nc", "--out", tmp_path, "--guide", "svi", "--steps", 2
    capsys.readouterr()
    assert command(fit, *args) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(errors) == 1
    assert "fit.checkpoint is not a checkpoint of this program; remove it" in errors[0]
    assert content(tmp_path) == {"fit.checkpoint": 8}


@pytest.mark.parametrize(
    ("module", "args", "message"),
    [
        (simulate, ("--domain", "flying"), 'unknown domain "flying"'),
        (simulate, ("--setting", "rain"), 'unknown setting "rain"'),
        (simulate, ("--population", "dense"), 'unknown population "dense"'),
        (simulate, ("--device", "abacus"), 'unknown device "abacus"'),
        (train, ("--domain", "flying"), 'unknown domain "flying"'),
        (train, ("--device", "abacus"), 'unknown device "abacus"'),
        (train, ("--card", "nowhere"), "nowhere: there is no such file"),
        (train, ("--out", "file/deep/x.safetensors"), "cannot create the folder file/deep"),
    ],
)
def test_other_commands_refuse_what_cannot_be_done(
    tmp_path, monkeypatch, capsys, module, args, message
):
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    out = () if "--out" in args else ("--out", "out.file")
    assert message in refused(capsys, tmp_path, module, *out, *args)


def test_recordings_that_cannot_be_written_leave_nothing(tmp_path, capsys):
    (tmp_path / "file").touch()
    args = "--people", 1, "--rounds", 1, "--out", tmp_path / "file" / "x.nc"
    assert command(simulate, *args) == 2
    assert f"error: cannot create the folder {tmp_path / 'file'}" in capsys.readouterr().err
    assert set(content(tmp_path)) == {"file"}


@pytest.mark.parametrize(
    ("module", "args", "message"),
    [
        (fit, ("--steps", "0"), "--steps must be at least 1, not 0"),
        (fit, ("--steps", "5"), "--steps is for --guide svi"),
        (
            simulate,
            ("--out", "x.nc", "--self-model", "nowhere"),
            "--self-model has no effect on the simulated people of driving, who are not made of "
            "it; leave it out",
        ),
        (fit, ("--draws", "-3"), "--draws must be at least 1, not -3"),
        (fit, ("--train-rounds", "-1"), "--train-rounds must be at least 0, not -1"),
        (fit, ("--explore", "-1"), "--explore must be at least 0, not -1"),
        (train, ("--phases", "0"), "--phases must be at least 1, not 0"),
        (train, ("--steps", "0"), "--steps must be at least 1, not 0"),
        (train, ("--learning-rate", "0"), "--learning-rate must be above 0 and at most 1, not 0.0"),
        (simulate, ("--out", "x.nc", "--people", "0"), "--people must be at least 1, not 0"),
        (simulate, ("--out", "x.nc", "--rounds", "0"), "--rounds must be at least 1, not 0"),
        (assist, ("--rounds", "0"), "--rounds must be at least 1, not 0"),
    ],
)
def test_impossible_values_are_refused_in_one_line(
    tmp_path, monkeypatch, capsys, module, args, message
):
    monkeypatch.chdir(tmp_path)
    assert refused(capsys, tmp_path, module, *args) == f"error: {message}\n"


@pytest.mark.parametrize(
    ("module", "args", "message"),
    [
        (fit, ("--draws", "many"), "many"),
        (fit, ("--drawz", "3"), "--draws"),
        (simulate, (), "--out"),
        (assist, ("--rounds", "few"), "few"),
    ],
)
def test_arguments_that_cannot_be_parsed_end_with_status_2(
    tmp_path, monkeypatch, capsys, module, args, message
):
    monkeypatch.chdir(tmp_path)
    assert command(module, *args) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert message in captured.err
    assert content(tmp_path) == {}

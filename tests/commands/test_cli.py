"""The commands: what they refuse, write and say, and that a killed fit goes on where it was."""

import functools
import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from example_recordings import fields
from running import command

from mirror_ppl import __main__
from mirror_ppl.commands import assist, calibrate, evaluate, fit, simulate, train
from mirror_ppl.data import (
    Demonstrations,
    asset_path,
    load_demonstrations,
    save_demonstrations,
    to_dataset,
)
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import DemonstrationsError
from mirror_ppl.evaluation import self_model as evaluation
from mirror_ppl.inference.results.export import in_units
from mirror_ppl.inference.results.fitting import split_rounds
from mirror_ppl.inference.results.summary import score, summarize
from mirror_ppl.models.weights import load_self_model

RESULTS = {
    "check.png",
    "identifiability.png",
    "posterior.nc",
    "samples.png",
    "sight.png",
    "summary.json",
}


def content(folder):
    return {str(path.relative_to(folder)): path.stat().st_size for path in folder.rglob("*")}


@pytest.fixture(scope="module")
def some():
    """Two people in fog, four rounds each: three to learn from, one held out."""
    every = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return every.select_people([0, 3]).select_rounds(range(4))


@pytest.fixture(scope="module")
def folder(some, tmp_path_factory):
    """A folder with recordings, and the results of a short fit of them in out/."""
    folder = tmp_path_factory.mktemp("cli")
    save_demonstrations(folder / "some.nc", some)
    assert command(fit, *short_fit(folder, "out")) == 0
    return folder


def short_fit(folder, out, *others, steps=4):
    some = "--demos", folder / "some.nc", "--out", folder / out
    return *some, "--guide", "svi", "--steps", steps, "--draws", 10, "--explore", 2, *others


RADIUS = "--human-model", "one-radius"
"""Arguments for a model with few combinations of perceptual implants, which is quick."""
RESULTS_OF_RADIUS = RESULTS - {"sight.png", "samples.png"}


def summary_of(folder):
    """The summary of results but for their times."""
    summary = json.loads((folder / "summary.json").read_text())
    assert summary.pop("seconds") > 0
    spent = summary.pop("processor_seconds")
    assert {"predict", "identify", "draw", "write"} <= set(spent)
    assert all(each >= 0 for each in spent.values())
    return summary


# --- what a fit writes ------------------------------------------------------------------------


def test_fit_writes_posterior_summary_and_picture(folder, some):
    assert set(content(folder / "out")) == RESULTS
    summary = summary_of(folder / "out")
    assert {key: summary[key] for key in ("domain", "setting", "seed")} == {
        "domain": "driving",
        "setting": "fog",
        "seed": 0,
    }
    assert summary["version"]
    assert [person["id"] for person in summary["people"]] == list(some.people)
    for index, person in enumerate(summary["people"]):
        assert person["rounds"] == 3
        for name, truth in some.truth.items():
            implant = person["implants"][name]
            assert implant["q05"] <= implant["median"] <= implant["q95"]
            assert implant["truth"] == truth[index].item()
        assert person["implants"]["lapse"]["truth"] is None
        entropy = some.action_entropy[index, 3].mean().item()
        assert person["test"]["floor"] == pytest.approx(entropy, rel=1e-5)
        assert 0 < person["test"]["nll"] < 3
        assert 0 <= person["test"]["accuracy"] <= 1
    assert (folder / "out" / "sight.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")


def test_posterior_opens_without_this_package_and_agrees_with_the_summary(folder):
    path = folder / "out" / "posterior.nc"
    summary = summary_of(folder / "out")
    groups = xr.open_groups(path, engine="h5netcdf")
    names = {name.strip("/") for name in groups} - {""}
    assert {"posterior", "prior", "posterior_predictive", "log_likelihood"} <= names
    assert {"observed_data", "constant_data", "predictions"} <= names
    posterior = groups["/posterior"]
    assert posterior.attrs["domain"] == "driving"
    for index, person in enumerate(summary["people"]):
        for name, implant in person["implants"].items():
            draws = posterior[name].isel(person=index).values.ravel()
            assert len(draws) == 10
            # Of 10 draws, 0.5 * 10 or more are at most the fifth, and so on.
            low, middle, high = np.sort(draws)[[0, 4, 9]]
            expected = {"q05": low, "median": middle, "q95": high}
            found = {key: implant[key] for key in expected}
            assert found == pytest.approx(expected, rel=1e-5)
    for group in groups.values():
        group.close()


def test_one_seed_gives_one_summary(folder):
    assert command(fit, *short_fit(folder, "one", *RADIUS)) == 0
    torch.manual_seed(99)
    assert command(fit, *short_fit(folder, "again", *RADIUS)) == 0
    assert summary_of(folder / "again") == summary_of(folder / "one")
    assert command(fit, *short_fit(folder, "other", *RADIUS), "--seed", 1) == 0
    other = summary_of(folder / "other")
    assert other.pop("seed") == 1
    assert other["people"] != summary_of(folder / "one")["people"]


def test_fit_says_what_it_found_and_where_it_lies(folder, capsys):
    assert command(fit, *short_fit(folder, "said"), "--train-rounds", 4) == 0
    captured = capsys.readouterr()
    for name in ("person-01", "person-04", "front own", "assumes clear", "consistency", *RESULTS):
        assert name in captured.out
    assert "Held-out actions" not in captured.out  # there are none
    assert "fit: 4/4 negative ELBO" in captured.err  # plain lines: it is no terminal
    assert "\x1b" not in captured.err
    people = summary_of(folder / "said")["people"]
    assert [(person["rounds"], person["test"]) for person in people] == [(4, None)] * 2


def test_shipped_recordings_are_those_that_are_asked_for():
    for setting in ("clear", "fog"):
        for population in ("paper", "diverse"):
            options = fit.Options(setting=setting, population=population)
            recordings = fit._recordings(options)
            assert recordings.setting == setting
            assert recordings.provenance["population"] == population
            assert recordings.shape == (10, 40, 15)


# --- killed -----------------------------------------------------------------------------------


def test_killed_fit_leaves_no_results_and_goes_on_from_its_checkpoint(folder, monkeypatch):
    args = [str(arg) for arg in short_fit(folder, "killed", *RADIUS, steps=80)]
    process = subprocess.Popen(
        [sys.executable, "-m", "mirror_ppl.fit", *args], stderr=subprocess.PIPE
    )
    checkpoint, deadline = folder / "killed" / "fit.checkpoint", time.monotonic() + 120
    try:
        while not checkpoint.exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        assert process.poll() is None, process.stderr.read().decode()
        assert checkpoint.exists()
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert not RESULTS & set(content(folder / "killed"))

    done = []
    report = fit.Stages.report

    def spy(self, name, step, total, message):
        done.extend([step] * (name == "fit"))
        report(self, name, step, total, message)

    monkeypatch.setattr(fit.Stages, "report", spy)
    assert command(fit, *args) == 0
    assert done[0] in (26, 51, 76)  # from a checkpoint, of which there is one in 25 steps
    assert set(content(folder / "killed")) >= RESULTS_OF_RADIUS
    assert not checkpoint.exists()
    assert command(fit, *short_fit(folder, "whole", *RADIUS, steps=80)) == 0
    assert summary_of(folder / "killed") == summary_of(folder / "whole")


# --- bad input --------------------------------------------------------------------------------


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
    "wrong shape": (lambda data: data.isel(time=slice(0, 15)), "ego has shape"),
    "missing variable": (lambda data: data.drop_vars("visual"), "variable visual is missing"),
    "nan": (
        put("visual", (1, 2, 5, 0, 0), math.nan),
        "visual of front-left, distance_ahead is nan",
    ),
    "action too high": (put("action", (0, 3, 7), 2), "action is 2, expected a whole number from 0"),
    "action too low": (put("action", (0, 3, 7), -1), "action is -1, expected a whole number"),
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
        (("--human-model", "mine.py:Dreamer"), 'perceive() reads "lapse"'),
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


# --- the other commands, and help -------------------------------------------------------------


def test_train_writes_weights_with_a_card(tmp_path, monkeypatch, capsys):
    quick = functools.partial(evaluation.self_model_quality, rounds=100)
    monkeypatch.setattr(evaluation, "self_model_quality", quick)
    path = tmp_path / "new" / "a.safetensors"
    assert command(train, "--out", path, "--phases", 2, "--steps", 1, "--seed", 3) == 0
    assert set(content(tmp_path / "new")) == {"a.safetensors"}
    _, card = load_self_model(path, "driving")
    assert "--phases 2 --steps 1" in card["command"]
    assert "--seed 3" in card["command"]
    assert card["settings"]["phases"] == 2
    assert {"mirror_ppl", "torch"} <= set(card["versions"])
    assert card["quality"]["return_exact"] > card["quality"]["return_clear"]
    trained = capsys.readouterr().out
    assert f"{card['quality']['share_clear']:.3f}" in trained
    assert command(train, "--card", path) == 0
    assert capsys.readouterr().out in trained


def test_simulate_writes_recordings_that_can_be_fitted(tmp_path, capsys):
    args = "--people", 2, "--rounds", 2, "--seed", 5, "--population", "diverse"
    assert command(simulate, *args, "--out", tmp_path / "new" / "a.nc") == 0
    assert command(simulate, *args, "--out", tmp_path / "b.nc") == 0
    assert "a.nc: driving, fog, population diverse" in capsys.readouterr().out
    one, two = (load_demonstrations(tmp_path / name) for name in ("new/a.nc", "b.nc"))
    assert one.equals(two)
    assert one.shape == (2, 2, 15)
    assert "--people 2 --rounds 2 --seed 5" in one.provenance["command"]
    small = "--train-rounds", 1, "--draws", 4, "--explore", 1, *RADIUS
    assert command(fit, "--demos", tmp_path / "b.nc", "--out", tmp_path / "out", *small) == 0
    assert set(content(tmp_path / "out")) == RESULTS_OF_RADIUS


@pytest.mark.parametrize("module", [assist, calibrate, evaluate, fit, train, simulate])
def test_help_explains_every_option(module, capsys):
    assert command(module, "--help") == 0
    out = " ".join(capsys.readouterr().out.split())
    for name in module.Options.__dataclass_fields__:
        if (module, name) != (evaluate, "study"):  # which is no option
            assert f"--{name.replace('_', '-')} " in out
    assert module.DESCRIPTION.split(".")[0].split("\n")[0].split(",")[0] in out
    assert f"python -m {module.__name__.replace('.commands', '')}" == module.PROGRAM


def test_overview_lists_every_command_there_is(capsys):
    assert __main__.main([]) == 0
    out = capsys.readouterr().out
    package = Path(fit.__file__).parent
    commands = {path.stem for path in package.glob("*.py")} - {"__init__"}
    assert set(__main__.COMMANDS) == commands
    assert all((package.parent / f"{name}.py").is_file() for name in commands)
    for name in __main__.COMMANDS:
        assert f"python -m mirror_ppl.{name}" in out


# --- rounds to learn from, and what is said of people -----------------------------------------


def numbered(rounds, more=0):
    """One person's rounds, whose lane is their number, in arrays with room for more."""
    variables = fields([[1] * (rounds + more)])
    count = torch.tensor([rounds])
    lengths = (torch.arange(rounds + more) < rounds).long()[None]
    lane = torch.arange(float(rounds + more))[None, :, None, None].expand(1, -1, 2, 1)
    return Demonstrations(**variables | {"ego": lane, "round_counts": count, "lengths": lengths})


@pytest.mark.parametrize(
    ("rounds", "train_rounds", "train", "test"),
    [
        (40, None, range(20), range(30, 36)),
        (36, None, range(20), range(30, 36)),
        (40, 1, range(1), range(30, 36)),
        (40, 30, range(30), range(30, 36)),
        (40, 31, range(31), range(31, 40)),
        (40, 40, range(40), None),
        (35, None, range(27), range(27, 35)),
        (4, None, range(3), range(3, 4)),
        (2, None, range(2), None),
        (1, None, range(1), None),
        (10, 4, range(4), range(4, 10)),
    ],
)
@pytest.mark.parametrize("more", [0, 9], ids=["", "padded"])
def test_split_of_rounds(rounds, train_rounds, train, test, more):
    parts = split_rounds(numbered(rounds, more), train_rounds)
    numbers = [None if part is None else part.ego[0, :, 0, 0].tolist() for part in parts]
    assert numbers == [list(train), None if test is None else list(test)]


@pytest.mark.parametrize("train_rounds", [-1, 5])
def test_rounds_that_are_not_there_cannot_be_learned_from(train_rounds):
    with pytest.raises(DemonstrationsError, match=f"cannot train on {train_rounds} of 4 rounds"):
        split_rounds(numbered(4), train_rounds)


def test_summary_by_hand():
    train = Demonstrations(
        **fields([[2], [1]])
        | {"truth": {"bias": torch.tensor([0.25, math.nan]), "reach": torch.ones(2)}}
    )
    action, entropy = torch.tensor([[[1, 0]], [[0, 0]]]), torch.tensor([[[0.5, 0.1]], [[0.0, 0.0]]])
    given = fields([[2], []]) | {"actions": action, "action_entropy": entropy}
    test = Demonstrations(**given)
    draws = {
        "bias": torch.arange(20.0).repeat(2, 1).T * torch.tensor([1.0, -1.0]),
        "weights": torch.zeros(20, 2, 3),
    }
    # Two draws: of the actions 1 and 0, probabilities 0.9 and 0.2, or 0.5 and 0.6.
    exact = torch.tensor([[[0.1, 0.9], [0.2, 0.8]], [[0.5, 0.5], [0.6, 0.4]]])
    log_probabilities = exact.log()[:, None, None].expand(2, 2, 1, 2, 2)
    first, second = summarize(draws, train, score(log_probabilities, test))
    assert first["id"] == "a"
    assert (first["rounds"], second["rounds"]) == (1, 1)
    assert first["implants"] == {"bias": {"median": 9.0, "q05": 0.0, "q95": 18.0, "truth": 0.25}}
    assert second["implants"] == {
        "bias": {"median": -10.0, "q05": -19.0, "q95": -1.0, "truth": None}
    }
    # Mixed over draws: 0.7 and 0.4, so the second action is not the likeliest.
    assert first["test"]["nll"] == pytest.approx(-(math.log(0.7) + math.log(0.4)) / 2, rel=1e-5)
    assert first["test"]["accuracy"] == 0.5
    assert first["test"]["floor"] == pytest.approx(0.3)
    assert second["test"] is None
    assert summarize(draws, train, None)[0]["test"] is None
    unknown = Demonstrations(**given | {"action_entropy": None})
    assert score(log_probabilities, unknown)[0]["floor"] is None


def test_bins_are_reported_in_cells():
    draws = {"sight_front_own": torch.tensor([[[0]], [[5]], [[6]]]), "lapse": torch.ones(3, 1, 1)}
    units = in_units(get_domain("driving"), draws)
    assert units["sight_front_own"].tolist() == [[0.0], [6.0], [12.0]]
    assert units["lapse"].shape == (3, 1)

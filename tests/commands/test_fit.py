"""`python -m mirror_ppl.fit`: what it writes and says, and that a killed fit goes on."""

import io
import json
import os
import signal
import time
from contextlib import redirect_stderr, redirect_stdout

import numpy as np
import pytest
import torch
import xarray as xr
from example_fits import RADIUS, RESULTS, RESULTS_OF_RADIUS, content, short_fit, two_people
from running import command

from mirror_ppl.commands import fit
from mirror_ppl.data import save_demonstrations


@pytest.fixture(scope="module")
def some():
    return two_people()


def said_by(*args):
    """What a fit says on its two streams."""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        assert command(fit, *args) == 0
    return out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def folder(some, tmp_path_factory):
    """A folder with recordings, and the results of a short fit of them in out/."""
    folder = tmp_path_factory.mktemp("cli")
    save_demonstrations(folder / "some.nc", some)
    out, err = said_by(*short_fit(folder, "out"))
    (folder / "said.out").write_text(out)
    (folder / "said.err").write_text(err)
    return folder


NOTHING_HELD_OUT = "--human-model", "no-implants", "--train-rounds", 4


@pytest.fixture(scope="module")
def quick(folder):
    """A fit of a model that is quicker still, of all rounds, and what it said."""
    out, _ = said_by(*short_fit(folder, "quick", *NOTHING_HELD_OUT))
    return folder / "quick", out


def summary_of(folder):
    """The summary of results but for their times."""
    summary = json.loads((folder / "summary.json").read_text())
    assert summary.pop("seconds") > 0
    spent = summary.pop("processor_seconds")
    assert {"predict", "identify", "draw", "write"} <= set(spent)
    assert all(each >= 0 for each in spent.values())
    return summary


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


def test_one_seed_gives_one_summary(folder, quick):
    torch.manual_seed(99)
    args = NOTHING_HELD_OUT
    said, _ = said_by(*short_fit(folder, "again", *args))
    assert summary_of(folder / "again") == summary_of(quick[0])
    assert "replaces" not in said
    said, _ = said_by(*short_fit(folder, "again", *args), "--seed", 1)
    assert "InferenceData; it replaces an earlier one" in said
    other = summary_of(folder / "again")
    assert other.pop("seed") == 1
    assert other["people"] != summary_of(quick[0])["people"]


def test_fit_says_what_it_found_and_where_it_lies(folder):
    out, err = ((folder / f"said.{stream}").read_text() for stream in ("out", "err"))
    for name in ("person-01", "person-04", "front own", "assumes clear", "consistency", *RESULTS):
        assert name in out
    assert "Held-out actions" in out
    assert "fit: 4/4 negative ELBO" in err  # plain lines: it is no terminal
    assert "\x1b" not in err


def test_nothing_is_said_of_held_out_actions_where_there_are_none(quick):
    folder, out = quick
    assert "consistency" in out
    assert "Held-out actions" not in out
    people = summary_of(folder)["people"]
    assert [(person["rounds"], person["test"]) for person in people] == [(4, None)] * 2


def test_shipped_recordings_are_those_that_are_asked_for():
    for setting in ("clear", "fog"):
        for population in ("paper", "diverse"):
            options = fit.Options(setting=setting, population=population)
            recordings = fit._recordings(options)
            assert recordings.setting == setting
            assert recordings.provenance["population"] == population
            assert recordings.shape == (10, 40, 15)


def test_a_cluster_finds_the_same(folder, cluster):
    """Each person is a task of its own, so that both workers have one."""
    demos = "--demos", folder / "some.nc", *RADIUS, "--draws", 10, "--explore", 2
    found = []
    for out, where in (("here", ("--jobs", 1)), ("there", ("--scheduler", cluster))):
        assert command(fit, *demos, "--guide", "importance", "--out", folder / out, *where) == 0
        found.append(summary_of(folder / out))
    assert found[0] == found[1]
    here, there = (xr.load_datatree(folder / out / "posterior.nc") for out in ("here", "there"))
    assert here.posterior.to_dataset().equals(there.posterior.to_dataset())
    assert here.predictions.to_dataset().equals(there.predictions.to_dataset())


def test_killed_fit_leaves_no_results_and_goes_on_from_its_checkpoint(folder, forks, monkeypatch):
    """A fit of some more steps, as there is a checkpoint in 25, of a model that is quick."""
    whole, args = (
        [str(arg) for arg in short_fit(folder, out, *RADIUS, steps=40)]
        for out in ("whole", "killed")
    )
    assert command(fit, *whole) == 0
    with open(os.devnull, "w") as nowhere:
        process = forks.start("mirror_ppl.fit", *args, stdout=nowhere, stderr=nowhere)
    checkpoint, deadline = folder / "killed" / "fit.checkpoint", time.monotonic() + 120
    while not checkpoint.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(process, signal.SIGKILL)
    assert forks.status(process) == -signal.SIGKILL
    assert checkpoint.exists()
    assert not RESULTS & set(content(folder / "killed"))

    done = []
    report = fit.Stages.report

    def spy(self, name, step, total, message):
        done.extend([step] * (name == "fit"))
        report(self, name, step, total, message)

    monkeypatch.setattr(fit.Stages, "report", spy)
    assert command(fit, *args) == 0
    assert done[:2] == [25, 26]
    assert set(content(folder / "killed")) >= RESULTS_OF_RADIUS
    assert not checkpoint.exists()
    assert summary_of(folder / "killed") == summary_of(folder / "whole")

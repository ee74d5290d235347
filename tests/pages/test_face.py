"""`mirror_ppl.infer` and what it returns: what most users call."""

import json
import subprocess
import sys
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
import xarray as xr
from refused import refused
from running import command

import mirror_ppl
from mirror_ppl.arviz import az
from mirror_ppl.commands import fit as fit_command
from mirror_ppl.communication import RoundSoFar
from mirror_ppl.data import save_demonstrations
from mirror_ppl.errors import (
    DemonstrationsError,
    InputError,
    PosteriorError,
    UnexplainedPerson,
    UnknownNameError,
    UnreliableWeights,
)
from mirror_ppl.inference.results.export import netcdf_content
from mirror_ppl.models import HumanModel
from mirror_ppl.models.variants import VARIANTS
from mirror_ppl.people import simulate


@pytest.fixture(scope="module")
def recordings():
    return mirror_ppl.load_recordings().select_people(["person-01", "person-04"])


@pytest.fixture(scope="module")
def fit(recordings):
    return mirror_ppl.infer(recordings, draws=30, train_rounds=2, explore=2, seed=3)


def test_nothing_is_imported_before_it_is_used():
    code = "import sys, mirror_ppl; print('torch' in sys.modules, dir(mirror_ppl))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("False ")
    assert "'infer'" in done.stdout
    with pytest.raises(AttributeError, match="has no attribute 'inferr'"):
        mirror_ppl.inferr  # noqa: B018


def test_the_command_writes_what_infer_returns(fit, recordings, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_demonstrations(tmp_path / "two.nc", recordings)
    options = ("--draws", 30, "--train-rounds", 2, "--explore", 2, "--seed", 3)
    assert command(fit_command, "--demos", "two.nc", *options, "--out", "command") == 0
    pictures = fit.save(tmp_path / "python")
    one, other = (
        json.loads((tmp_path / name / "summary.json").read_text()) for name in ("command", "python")
    )
    assert one.pop("seconds") > 0
    assert one.pop("processor_seconds").keys() == other.pop("processor_seconds").keys()
    assert one == other
    names = {"summary.json", "posterior.nc", *pictures}
    for folder in ("command", "python"):
        assert {file.name for file in (tmp_path / folder).iterdir()} - {".fit.lock"} >= names
    sights = [(tmp_path / name / "sight.png").read_bytes() for name in ("command", "python")]
    assert sights[0] == sights[1]
    one, other = (
        az.from_netcdf(tmp_path / name / "posterior.nc") for name in ("command", "python")
    )
    assert one.groups() == other.groups()
    for group in one.groups():
        xr.testing.assert_equal(one[group], other[group])


def test_a_fit_says_what_it_is(fit):
    assert repr(fit) == "Fit(driving, fog: 2 people, auto, 30 draws)"
    assert fit.people == ("person-01", "person-04")
    person = fit.person("person-04")
    assert repr(person) == "FittedPerson(person-04: 2 rounds)"
    assert person.implants.loc["sight_front_own", "truth"] == 2
    assert list(person.implants.columns[:3]) == ["median", "q05", "q95"]
    own = fit.data.posterior["consistency"].sel(person="person-04").values[0]
    np.testing.assert_allclose(person.draws["consistency"][:, 0, 0], own)


def test_pictures_are_drawn(fit):
    for picture in (
        fit.plot.sight(),
        fit.plot.samples(),
        fit.plot.implants("person-01"),
        fit.plot.identifiability(),
        fit.plot.predictive_check(),
        fit.plot.round("person-01", 0),
    ):
        assert picture.content().startswith(b"\x89PNG")


def test_messages_are_planned(fit):
    communicator = mirror_ppl.Communicator(fit, "person-01", draws=8, horizon=3)
    assert communicator.person.number == 8
    assert communicator.objective.horizon == 3
    domain = mirror_ppl.worlds["driving"]
    state = domain.initial(1, torch.Generator().manual_seed(0))
    now = {name: value[0] for name, value in domain.observe(state).items()}
    decision = communicator.plan(RoundSoFar.begin(domain, now))
    assert decision.why()
    kl = mirror_ppl.Communicator(fit, "person-01", planner="mirror-kl", draws=8)
    assert kl.search.steps == 1


@pytest.fixture(scope="module")
def saved(fit, tmp_path_factory):
    """The posterior file of the fit."""
    folder = tmp_path_factory.mktemp("saved")
    fit.save(folder)
    return folder / "posterior.nc"


def test_messages_are_planned_from_a_saved_posterior(fit, recordings, saved):
    moment = RoundSoFar.of(recordings, "person-04", 7, 5)
    one = mirror_ppl.Communicator(fit, "person-04", draws=8, horizon=3)
    other = mirror_ppl.Communicator(str(saved), "person-04", draws=8, horizon=3)
    for site, value in one.person.draws.items():
        if not site.startswith("residual_"):  # which files hold to eight bits
            torch.testing.assert_close(other.person.draws[site], value)
    assert other.plan(moment).message == one.plan(moment).message
    assert mirror_ppl.Communicator(saved, "person-01").person.number == 30


class Unnamed(HumanModel):
    """A human model that no name stands for."""


def test_a_saved_posterior_of_a_users_model_needs_the_model(recordings, tmp_path):
    some = recordings.select_people(["person-01"])
    mirror_ppl.infer(some, human=Unnamed, draws=5, train_rounds=1, explore=0).save(tmp_path)
    path = tmp_path / "posterior.nc"
    refused(
        lambda: mirror_ppl.Communicator(path),
        "is of your own human model Unnamed; give it as human=",
    )
    found = mirror_ppl.Communicator(path, human=Unnamed)
    assert isinstance(found.person.human, Unnamed)
    assert found.person.number == 5


def test_saved_posteriors_that_cannot_be_planned_with(fit, saved, tmp_path):
    communicator = mirror_ppl.Communicator
    with pytest.raises(PosteriorError, match="there is no such file; python -m mirror_ppl.fit"):
        communicator(tmp_path / "none.nc", "person-01")
    with pytest.raises(UnknownNameError, match='unknown person "person-05"'):
        communicator(saved, "person-05")
    refused(lambda: communicator(saved), "is of 2 people: name one of them, such as 'person-01'")
    with pytest.raises(PosteriorError, match="is of human model mirror, not one-radius"):
        communicator(saved, "person-01", human="one-radius")
    refused(
        lambda: communicator(fit, "person-01", human="mirror"),
        "human and self_model are for a saved posterior; a fit has both",
    )


def test_one_person_need_not_be_named(recordings):
    one = recordings.select_people(["person-04"])
    fit = mirror_ppl.infer(one, draws=5, train_rounds=1, explore=0)
    assert fit.person().name == "person-04"
    assert mirror_ppl.Communicator(fit).person.number == 5


@pytest.mark.parametrize(
    "human", ["one-radius", VARIANTS["one-radius"], None], ids=["name", "class", "object"]
)
def test_human_models_are_named_or_given(recordings, human, fit):
    kind = VARIANTS["one-radius"]
    human = kind(fit.human.self_model) if human is None else human
    found = mirror_ppl.infer(recordings, human=human, draws=5, train_rounds=1, explore=0)
    assert isinstance(found.human, kind)
    assert "sight_radius" in found.data.posterior


def test_a_human_model_is_an_object_a_class_or_a_name():
    for wrong in (3, dict):
        with pytest.raises(InputError, match="human must be a human model, its class or its name"):
            mirror_ppl.infer(human=wrong)


def test_files_are_read(tmp_path):
    save_demonstrations(tmp_path / "one.nc", simulate("driving", "clear", "paper", 1, 2, 0))
    fit = mirror_ppl.infer(str(tmp_path / "one.nc"), draws=5, explore=0)
    assert fit.summary["setting"] == "clear"
    refused(
        lambda: mirror_ppl.load_recordings(tmp_path / "one.nc", setting="fog"),
        "setting is fog, but the recordings are of clear",
    )
    refused(
        lambda: mirror_ppl.load_recordings(tmp_path / "one.nc", population="paper"),
        "population is of the shipped recordings",
    )
    with pytest.raises(DemonstrationsError, match="there is no such file"):
        mirror_ppl.infer(tmp_path / "none.nc")


WRONG = {
    "person": (lambda fit: fit.person("person-02"), UnknownNameError, 'unknown person "person-02"'),
    "nobody": (lambda fit: fit.person(), InputError, "of 2 people: name one of them, such as"),
    "planner": (
        lambda fit: mirror_ppl.Communicator(fit, "person-01", planner="oracle"),
        UnknownNameError,
        'unknown planner "oracle"; known: mirror, mirror-kl, mirror-self-model',
    ),
    "setting": (
        lambda fit: mirror_ppl.Communicator(fit, "person-01", horizn=3),
        UnknownNameError,
        'unknown setting "horizn"; .*horizon',
    ),
    "no fit": (
        lambda fit: mirror_ppl.Communicator(fit.data),
        InputError,
        "fit must be of the class Fit",
    ),
    "engine": (
        lambda fit: mirror_ppl.infer(fit.train, engine="sv"),
        UnknownNameError,
        'unknown engine "sv"',
    ),
    "settings": (
        lambda fit: mirror_ppl.infer(fit.train, engine="svi", settings=3),
        InputError,
        "settings must be of the class SVIOptions",
    ),
    "guide": (
        lambda fit: mirror_ppl.infer(fit.train, engine="svi", guide_file="guide.safetensors"),
        InputError,
        "guide_file is for the engines auto and amortized",
    ),
    "pooling": (
        lambda fit: mirror_ppl.infer(fit.train, pooling="partial", prior_from="posterior.nc"),
        InputError,
        "prior_from is for people who are not pooled",
    ),
    "self-model": (
        lambda fit: mirror_ppl.infer(fit.train, human=fit.human, self_model="weights"),
        InputError,
        "self_model is for a human model that is to be made",
    ),
    "world": (
        lambda fit: mirror_ppl.load_recordings(domain="flying"),
        UnknownNameError,
        'unknown domain "flying"',
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_cannot_be_is_refused(fit, wrong):
    call, kind, message = WRONG[wrong]
    with pytest.raises(kind, match=message):
        call(fit)


def test_worlds_without_a_picture_say_so():
    some = mirror_ppl.load_recordings(domain="bomb_defusal").select_people(["person-01"])
    fit = mirror_ppl.infer(some, draws=5, train_rounds=1, explore=0, human="policy-only")
    for draw in (fit.plot.sight, fit.plot.predictive_check, fit.plot.identifiability):
        with pytest.raises(InputError):
            draw()
    assert fit.plot.implants("person-01").content()


def test_settings_may_be_given_by_name(recordings):
    some = recordings.select_people(["person-01"])
    fit = mirror_ppl.infer(
        some, engine="svi", settings={"steps": 3}, draws=5, train_rounds=1, explore=0
    )
    assert len(fit.posterior.losses) == 3
    with pytest.raises(UnknownNameError, match='unknown setting "stpes"; .* meant "steps"'):
        mirror_ppl.infer(some, engine="svi", settings={"stpes": 3})


def test_nothing_is_no_recordings():
    with pytest.raises(InputError, match="recordings are None; leave them out"):
        mirror_ppl.infer(None)


@pytest.mark.parametrize(
    "data", [xr.Dataset({"action": ("step", [1, 0])}), np.zeros((2, 3)), 3, ["a.nc"]]
)
def test_other_data_are_no_recordings(data):
    with pytest.raises(InputError, match=f"recordings are of the class {type(data).__name__}, exp"):
        mirror_ppl.infer(data)


def test_unreliable_weights_are_reported(fit, recordings, monkeypatch):
    monkeypatch.setattr("mirror_ppl.fitted.HIGH_PARETO_K", -9.0)
    with pytest.warns(UnreliableWeights, match="weights of person-01 are not to be relied on"):
        found = mirror_ppl.infer(
            recordings.select_people(["person-01"]), draws=5, train_rounds=3, explore=0
        )
    assert "not to be relied on: person-01" in repr(found)
    assert repr(found.person()) == "FittedPerson(person-01: 3 rounds; weights not to be relied on)"


def test_an_unexplained_person_gets_no_messages(fit, recordings, tmp_path):
    """From a fit and from its file, unless asked for; of others nothing is said."""
    summary = deepcopy(fit.summary)
    summary["people"][0]["check"]["verdict"] = "unexplained"
    data = deepcopy(fit.data)
    data["model_check"]["verdict"] = "person", np.array(["unexplained", "ok"])
    other = replace(fit, summary=summary, data=data)
    (tmp_path / "posterior.nc").write_bytes(netcdf_content(data))
    first, second = fit.people[:2]
    for source in (other, tmp_path / "posterior.nc"):
        with pytest.warns(
            UnexplainedPerson, match=f"not explain the actions of {first} .*no messages are"
        ):
            silent = mirror_ppl.Communicator(source, first)
        with pytest.warns(
            UnexplainedPerson, match=f"not explain the actions of {first} .*may do harm"
        ):
            speaking = mirror_ppl.Communicator(source, first, plan_anyway=True)
        mirror_ppl.Communicator(source, second)
        past = RoundSoFar.of(recordings, first, 7, 5)
        assert speaking.plan(past).found is not None
        whole = RoundSoFar.of(recordings, first, 6, int(recordings.mask[0, 6].sum()))
        for planner in (silent, silent.after(whole)):
            decision = planner.plan(past)
            assert not decision.message and decision.found is None
            assert (
                decision.why() == "silence: the human model does not explain this person's actions"
            )


def test_some_people_are_fitted(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    options = ("--train-rounds", 1, "--draws", 5, "--explore", 0, "--out", "one")
    assert command(fit_command, "--people", "person-03", *options) == 0
    summary = json.loads((tmp_path / "one" / "summary.json").read_text())
    assert [person["id"] for person in summary["people"]] == ["person-03"]
    capsys.readouterr()
    assert command(fit_command, "--people", "person-3", *options) == 2
    assert "person-3" in capsys.readouterr().err


def test_moments_of_recordings(fit, recordings):
    past = RoundSoFar.of(recordings, "person-04", 7, 5)
    assert torch.equal(past.actions, recordings.actions[1, 7, :5])
    now = recordings.observation()["visual"][1, 7, 5]
    assert torch.equal(past.now["visual"], now)
    communicator = mirror_ppl.Communicator(fit, "person-04")
    decision = communicator.plan(past)
    assert repr(decision) == f"Decision({decision.why()})"
    assert repr(communicator) == "Communicator(ExpectedUtility, 30 draws)"


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({}, "the recordings are of 2 people: name one of them"),
        ({"person": "person-05"}, 'unknown person "person-05"'),
        ({"person": "person-01", "number": 40}, "person-01 has rounds 0 to 39, not 40"),
        ({"person": "person-01", "step": 16}, "round 0 of person-01 has steps 0 to 15, not 16"),
    ],
)
def test_moments_that_are_not_recorded_are_refused(recordings, asked, message):
    with pytest.raises((InputError, UnknownNameError), match=message):
        RoundSoFar.of(recordings, **asked)


def test_recordings_are_no_moment(fit, recordings):
    with pytest.raises(InputError, match=r"must be a RoundSoFar, not recordings: RoundSoFar.of"):
        mirror_ppl.Communicator(fit, "person-01").plan(recordings)

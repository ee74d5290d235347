"""`python -m mirror_ppl.assist`: what it writes and prints and refuses, and that it resumes."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import h5py
import pytest
from paths import EXAMPLES
from running import command

from mirror_ppl import infer
from mirror_ppl.commands import assist, fit
from mirror_ppl.data import asset_path, load_demonstrations, save_demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.driving import Driving
from mirror_ppl.evaluation import assistance_cells
from mirror_ppl.evaluation.assistance import COMMUNICATORS
from mirror_ppl.inference.results.export import netcdf_content

SMALL = ("--rounds", "2", "--draws", "4", "--horizon", "2", "--jobs", "1")


@pytest.fixture(scope="module")
def posterior(tmp_path_factory):
    """A posterior of two people in fog, after a few steps."""
    folder = tmp_path_factory.mktemp("assist")
    every = load_demonstrations(asset_path("driving_fog_paper.nc"))
    save_demonstrations(folder / "some.nc", every.select_people([0, 1]).select_rounds(range(3)))
    small = ("--demos", folder / "some.nc", "--explore", "0", "--draws", "6")
    assert command(fit, *small, "--out", folder / "out") == 0
    return folder / "out" / "posterior.nc"


def posterior_of(recordings, folder, **options):
    """The file of a posterior, without the pictures of a fit."""
    fitted = infer(recordings, explore=0, **options)
    path = folder / "posterior.nc"
    path.write_bytes(bytes(netcdf_content(fitted.data)))
    return path


def content(folder):
    return sorted(path.name for path in folder.iterdir())


def results_of(path):
    """Results but for times."""
    results = json.loads(path.read_text())
    for entry in results["communicators"].values():
        assert entry.pop("milliseconds") >= 0
    return results


@pytest.fixture(scope="module")
def done(posterior, tmp_path_factory):
    """A folder with the results and the log of every communicator."""
    folder = tmp_path_factory.mktemp("done")
    outputs = ("--json", folder / "a.json", "--log", folder / "a.jsonl", "--film", folder / "a.png")
    assert command(assist, "--posterior", posterior, *SMALL, *outputs) == 0
    return folder


# --- what it writes and prints ----------------------------------------------------------------


def test_results_hold_every_communicator(done):
    assert content(done) == ["a.json", "a.jsonl", "a.png"]
    results = results_of(done / "a.json")
    assert tuple(results["communicators"]) == COMMUNICATORS
    assert results["options"]["rounds"] == 2
    assert results["posterior"]["recorded_population"] == "paper"
    assert set(results["mirror_above"]) == set(COMMUNICATORS) - {"mirror"}
    for entry in results["communicators"].values():
        assert entry["net"] == pytest.approx(entry["task"] - entry["cost"])
        assert len(entry["net_by_person"]) == 2
    none = results["communicators"]["none"]
    assert none["cost"] == 0 and none["over_none"]["mean"] == 0
    # On what happened, not on average, somebody may do better than the oracle; but all agree on
    # where the way begins and ends.
    assert none["way_to_oracle"]["mean"] == 0
    assert results["communicators"]["oracle"]["way_to_oracle"]["mean"] == 1


def test_the_log_holds_every_decision(done):
    lines = [json.loads(line) for line in (done / "a.jsonl").read_text().splitlines()]
    steps = get_domain("driving").horizon
    assert len(lines) == len(COMMUNICATORS) * 2 * 2 * steps
    places = {(line["communicator"], line["person"], line["round"], line["step"]) for line in lines}
    assert len(places) == len(lines)
    planned = [line for line in lines if line["communicator"].startswith("mirror")]
    assert all(line["why"] and line["alternatives"] for line in planned if line["step"] < steps - 1)
    cost = sum(line["cost"] for line in lines if line["communicator"] == "mirror")
    # Of two people and two rounds each.
    expected = results_of(done / "a.json")["communicators"]["mirror"]["cost"]
    assert cost / 4 == pytest.approx(expected, abs=1e-6)


def test_the_table_shows_the_numbers(posterior, capsys):
    chosen = ("--communicator", "oracle", "none")
    assert command(assist, "--posterior", posterior, *SMALL, *chosen) == 0
    captured = capsys.readouterr()
    worth, said = captured.out.split("What is communicated")
    rows = {line.split()[0]: line.split() for line in worth.splitlines() if line.strip()}
    assert "driving, fog: 2 people, 2 rounds each" in captured.out
    assert rows["none"][2] == "0.00" and float(rows["none"][1]) < 0
    assert " none " in said and " oracle " in said
    assert {"task", "cost", "net"} <= set(captured.out.split())
    assert worth.index(" none ") < worth.index(" oracle ")
    assert all(len(line) <= 80 for line in captured.out.splitlines())
    assert "2/2" in captured.err


def test_another_seed_gives_another_result(posterior, done, tmp_path):
    """One gives the same: a cluster, below, plays what is played here."""
    chosen = ("--communicator", "mirror", "--json", tmp_path / "a.json", "--seed", 1)
    assert command(assist, "--posterior", posterior, *SMALL, *chosen) == 0
    other = results_of(tmp_path / "a.json")["communicators"]["mirror"]
    before = results_of(done / "a.json")["communicators"]["mirror"]
    assert other["net_by_person"] != before["net_by_person"]


def test_alone_or_among_others_a_communicator_plays_the_same(posterior, done, tmp_path):
    outputs = ("--communicator", "random", "--json", tmp_path / "a.json", "--people", "1")
    assert command(assist, "--posterior", posterior, *SMALL, *outputs) == 0
    alone = results_of(tmp_path / "a.json")["communicators"]
    assert list(alone) == ["random"]
    among = results_of(done / "a.json")["communicators"]["random"]
    assert alone["random"]["net_by_person"] == among["net_by_person"][:1]


def test_a_cluster_plays_the_same(posterior, done, cluster, tmp_path):
    chosen = ("--communicator", "mirror", "random", "--json", tmp_path / "a.json")
    there = ("--scheduler", cluster)
    assert command(assist, "--posterior", posterior, *SMALL, *chosen, *there) == 0
    there = results_of(tmp_path / "a.json")["communicators"]
    here = results_of(done / "a.json")["communicators"]
    for name in ("mirror", "random"):
        assert there[name].items() <= here[name].items()


# --- resuming ---------------------------------------------------------------------------------


class Stopped(Exception):
    """Stands for a run that is killed."""


def test_a_stopped_run_goes_on_where_it_was(posterior, tmp_path, monkeypatch):
    monkeypatch.setattr(assistance_cells, "TOGETHER", 1)
    args = ("--posterior", posterior, *SMALL, "--communicator", "none", "all", "nearest")
    outputs = ("--json", tmp_path / "a.json")
    assert command(assist, *args, "--json", tmp_path / "whole.json") == 0
    played = []
    play = assistance_cells.Pairing.play

    def stops(self, numbers, name, rates):
        if len(played) == 4:
            raise Stopped
        played.append((name, numbers))
        return play(self, numbers, name, rates)

    monkeypatch.setattr(assistance_cells.Pairing, "play", stops)
    with pytest.raises(Stopped):
        command(assist, *args, *outputs)
    assert content(tmp_path) == [".a.json.parts", "whole.json"]
    first, played[:] = list(played), []
    assert command(assist, *args, *outputs) == 0
    assert len(first) == 4 and len(played) == 2 and not set(first) & set(played)
    assert content(tmp_path) == ["a.json", "whole.json"]
    assert (
        results_of(tmp_path / "a.json")["communicators"]
        == results_of(tmp_path / "whole.json")["communicators"]
    )


def test_damaged_parts_are_played_anew(posterior, tmp_path, monkeypatch):
    monkeypatch.setattr(assistance_cells, "TOGETHER", 1)
    args = ("--posterior", posterior, *SMALL, "--communicator", "none")
    outputs = ("--json", tmp_path / "a.json")

    def stops(*args):
        raise Stopped

    with monkeypatch.context() as patch:
        patch.setattr("mirror_ppl.evaluation.assistance_summary.summarize_assistance", stops)
        with pytest.raises(Stopped):
            command(assist, *args, *outputs)
    parts = sorted((tmp_path / ".a.json.parts").iterdir())
    assert len(parts) == 2
    parts[0].write_text("{")
    whole = json.loads(parts[1].read_text())
    parts[1].write_text(json.dumps(whole | {"result": {"none": [{"task": [1.0]}]}}))
    assert command(assist, *args, *outputs) == 0
    assert results_of(tmp_path / "a.json")["communicators"]["none"]["cost"] == 0
    assert content(tmp_path) == ["a.json"]


# --- what it refuses --------------------------------------------------------------------------


def test_files_that_are_no_posterior_are_refused(tmp_path, capsys):
    (tmp_path / "broken.nc").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(200))
    assert command(assist, "--posterior", tmp_path / "broken.nc") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "broken.nc: is truncated or damaged" in error
    assert command(assist, "--posterior", tmp_path / "none.nc") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "none.nc: there is no such file" in error


def changed(posterior, path, **attributes):
    """A copy of the posterior with other attributes; None removes one."""
    shutil.copyfile(posterior, path)
    with h5py.File(path, "r+") as file:
        for name, value in attributes.items():
            del file["posterior"].attrs[name]
            if value is not None:
                file["posterior"].attrs[name] = value
    return path


@pytest.fixture
def quickly(monkeypatch):
    """Return a function that names the communicators to play; all others play as ``none``."""
    play = assistance_cells.Pairing.play

    def play_only(*names):
        def instead(self, numbers, name, rates):
            return play(self, numbers, name if name in names else "none", rates)

        monkeypatch.setattr(assistance_cells.Pairing, "play", instead)

    return play_only


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"domain": "chess"}, 'unknown domain "chess"; known: bomb_defusal, driving'),
        ({"domain_version": "99"}, "is of domain version 99, not"),
        ({"self_model": "0" * 16}, f"is of self model {'0' * 16}, not"),
        (
            {"human_model": "LatePerson"},
            "is of your own human model LatePerson; give it as --human",
        ),
        ({"recorded_population": None}, "is not of simulated people, as far as it says"),
        ({"recorded_population": "martians"}, 'unknown population "martians"'),
    ],
)
def test_posteriors_of_something_else_are_refused(posterior, tmp_path, capsys, attributes, message):
    path = changed(posterior, tmp_path / "other.nc", **attributes)
    assert command(assist, "--posterior", path, *SMALL, "--communicator", "none") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and message in error


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--setting", "clear"), "is of people in the setting fog, not clear"),
        (("--setting", "rain"), 'unknown setting "rain"'),
        (("--domain", "chess"), "chess"),
        (("--communicator", "nobody"), 'unknown communicator "nobody"'),
        (("--people", "3"), "is of 2 people, not 3"),
        (("--people", "0"), "--people must be at least 1, not 0"),
        (("--people", "9" * 5000), "is of 2 people, not 999"),
        (("--people", "person-01", "ann"), 'unknown person "ann"; known: person-01, person-02'),
        (("--draws", "7"), "holds 6 draws, not 7: ask for 6 or fewer"),
        (("--draws", "0"), "--draws must be at least 1, not 0"),
        (("--horizon", "0"), "--horizon must be at least 1, not 0"),
        (("--patience", "0"), "--patience must be at least 1, not 0"),
        (("--discount", "1.5"), "--discount must be above 0 and at most 1, not 1.5"),
        (("--discount", "nan"), "--discount must be above 0 and at most 1, not nan"),
        (("--enumerate-above", "-1"), "--enumerate-above must be from 0 to 1, not -1.0"),
        (("--min-standard-errors", "-1"), "--min-standard-errors must be at least 0, not -1.0"),
        (("--hears", "0"), "--hears must be above 0 and at most 1, not 0.0"),
        (("--hears", "1.5"), "--hears must be above 0 and at most 1, not 1.5"),
        (("--kl-weight", "0"), "--kl-weight must be a positive number, not 0.0"),
        (("--kl-weight", "inf"), "--kl-weight must be a positive number, not inf"),
        (("--seed", "-1"), "--seed must be at least 0, not -1"),
        (("--people-seed", "-1"), "--people-seed must be at least 0, not -1"),
        (("--people-seed", "5"), "is of people with seed 0, not 5 (--people-seed)"),
        (("--population", "diverse"), "is of people with population paper, not diverse"),
        (("--film", "film.mp4"), "--film must end in .png, .pdf, .svg, not film.mp4"),
        (
            ("--film", "film.png", "--communicator", "none"),
            "--film compares two communicators, not none alone",
        ),
        (("--kl-measure", "cosine"), '--kl-measure must be kl or squared, not "cosine"'),
        (("--self-model", "nowhere.safetensors"), "nowhere.safetensors"),
        (("--human-model", "nowhere.py:Class"), "nowhere.py"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(
    posterior, tmp_path, monkeypatch, capsys, args, message
):
    monkeypatch.chdir(tmp_path)
    assert command(assist, "--posterior", posterior, "--json", "a.json", *args) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert message in captured.err
    assert content(tmp_path) == []


@pytest.mark.parametrize("option", ["horizon", "discount", "patience", "enumerate_above"])
def test_options_of_planners_that_look_ahead(option, capsys):
    options = assist.Options(**{option: 1})
    for chosen in (["mirror"], ["random", "none"], ["mirror-self-model"], ["oracle"]):
        assist._warn_of_unused(options, chosen, "simulator")
    assist._warn_of_unused(options, ["mirror-self-model"], "values")
    assist._warn_of_unused(assist.Options(), ["mirror"], "values")
    assert capsys.readouterr().err == ""
    assist._warn_of_unused(options, ["mirror", "mirror-kl"], "values")
    named = f"--{option.replace('_', '-')}"
    assert capsys.readouterr().err == f"warning: {named} has no effect on mirror, mirror-kl\n"


def test_options_that_nobody_uses_are_named(posterior, capsys):
    given = "--communicator", "none", "--kl-weight", 3
    assert command(assist, "--posterior", posterior, *SMALL, *given) == 0
    warned = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert warned == [
        f"warning: {one} has no effect on none" for one in ("--horizon", "--kl-weight")
    ]


def test_outputs_that_would_overwrite_are_refused(posterior, tmp_path, capsys):
    before = posterior.read_bytes()
    for args, message in (
        (("--json", posterior), "it is what --posterior names"),
        (("--json", tmp_path / "a", "--log", tmp_path / "a"), "it is what --json names"),
        (("--log", tmp_path), "it is not a regular file"),
        (
            ("--self-model", posterior.with_name("x"), "--log", posterior.with_name("x")),
            "--self-model",
        ),
    ):
        assert command(assist, "--posterior", posterior, *SMALL, *args) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and message in error
    assert posterior.read_bytes() == before
    assert content(tmp_path) == []


# --- human models of one's own ----------------------------------------------------------------


def test_a_model_that_remembers_more_is_planned_with_but_has_no_divergence(
    posterior, tmp_path, capsys, quickly
):
    quickly("mirror", "mirror-self-model")
    example = EXAMPLES / "late_reactions.py"
    late = ("--human-model", f"{example}:LatePerson")
    some = load_demonstrations(posterior.parents[1] / "some.nc")
    one = some.select_people([0]).select_rounds([0])
    path = posterior_of(one, tmp_path, human=late[1], train_rounds=0, draws=6)
    own = ("--posterior", path, *late, *SMALL, "--people", "1", "--rounds", "1")
    assert command(assist, *own, "--communicator", "mirror-kl", "mirror") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "beliefs of LatePerson have no density like the robot's" in error
    assert "mirror-kl" in error
    assert command(assist, *own, "--json", tmp_path / "a.json") == 0
    error = capsys.readouterr().err
    assert "mirror-kl is left out: beliefs of LatePerson have no density" in error
    played = results_of(tmp_path / "a.json")["communicators"]
    assert tuple(played) == tuple(name for name in COMMUNICATORS if name != "mirror-kl")


def test_a_world_s_record_of_planning_holds_unless_options_say_otherwise(monkeypatch):
    planning = {"discount": 0.5, "hears": 0.7, "kl_weight": 2.0, "kl_measure": "squared"}
    monkeypatch.setattr(Driving, "record", replace(Driving.record, planning=planning))
    attributes = {"domain": "driving", "setting": "fog"}
    posterior = SimpleNamespace(attributes=attributes, people=("person-01",))
    for given in ({}, {"hears": 0.8, "kl_measure": "kl"}):
        options = assist.Options(posterior="posterior.nc", **given)
        source = {"population": "paper", "seed": 0}
        planner = assist._pairing(options, posterior, source, ("person-01",)).planner
        assert {name: getattr(planner, name) for name in planning} == {**planning, **given}


def test_nobody_plans_in_a_world_that_the_robot_was_taught_wrong_unless_asked_to(
    tmp_path, capsys, quickly
):
    quickly("mirror", "mirror-self-model")
    everybody = load_demonstrations(asset_path("bomb_defusal_unlabelled_paper.nc"))
    one = everybody.select_people([0]).select_rounds([0])
    path = posterior_of(one, tmp_path, train_rounds=0, draws=4)
    bomb = ("--posterior", path, "--rounds", "1", "--draws", "4")
    bomb += ("--horizon", "1", "--patience", "1", "--jobs", "1", "--json", tmp_path / "a.json")
    assert command(assist, *bomb) == 0
    told = "mirror-self-model is left out: the robot was taught wrong in bomb_defusal"
    assert told in capsys.readouterr().err
    played = results_of(tmp_path / "a.json")["communicators"]
    assert tuple(played) == tuple(name for name in COMMUNICATORS if name != "mirror-self-model")
    assert command(assist, *bomb, "--communicator", "mirror-self-model") == 0
    assert "left out" not in capsys.readouterr().err
    assert tuple(results_of(tmp_path / "a.json")["communicators"]) == ("mirror-self-model",)


def test_what_others_keep_in_the_folder_of_parts_stays(posterior, tmp_path):
    parts = tmp_path / ".a.json.parts"
    parts.mkdir()
    (parts / "notes.json").write_text("{}")
    args = ("--communicator", "none", "--json", tmp_path / "a.json")
    assert command(assist, "--posterior", posterior, *SMALL, *args) == 0
    assert content(parts) == ["notes.json"]

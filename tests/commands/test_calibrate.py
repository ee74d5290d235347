"""`python -m mirror_ppl.calibrate`, on toys whose posterior is quick."""

import pytest
from PIL import Image
from running import command, command_on_cluster

from mirror_ppl.commands import calibrate
from mirror_ppl.inference.calibration.study import Calibration
from mirror_ppl.inference.engines import Inferred, infer

TOY = """from mirror_ppl.models.toy import ToyHuman


class Toy(ToyHuman):
    pass
"""
RESULTS = {"calibration.nc", "ranks.png", "ecdf.png", "coverage.png"}


@pytest.fixture
def small(tmp_path):
    """Arguments that make it quick."""
    path = tmp_path / "toy.py"
    path.write_text(TOY)
    out = tmp_path / "out"
    return (
        "--human-model",
        f"{path}:Toy",
        "--people",
        60,
        "--rounds",
        1,
        "--out",
        out,
        "--draws",
        19,
    )


def names(folder):
    return {path.name for path in folder.iterdir()}


def test_it_prints_and_writes_what_it_found(small, tmp_path, capsys):
    assert command(calibrate, *small, "--jobs", 1) == 0
    out, err = capsys.readouterr()
    assert "60 people drawn from the prior" in out
    words = "reach", "in sight", "otherwise", "not rejected for any of 3", "calibration.nc"
    for word in (*words, "Of 60 people, only gross faults would show"):
        assert word in out
    assert "12/12 people " in err
    assert names(tmp_path / "out") == RESULTS
    calibration = Calibration.load(tmp_path / "out" / "calibration.nc")
    assert calibration.people == 60 and calibration.draws == 19
    assert calibration.data.attrs["human_model"] == "Toy"
    with Image.open(tmp_path / "out" / "ranks.png") as image:
        assert len(image.convert("L").getcolors()) > 10


def test_processes_share_the_people(small, tmp_path):
    assert command(calibrate, *small, "--jobs", 1) == 0
    alone = Calibration.load(tmp_path / "out" / "calibration.nc")
    other = [tmp_path / "shared" if part == tmp_path / "out" else part for part in small]
    assert command(calibrate, *other, "--jobs", 2) == 0
    shared = Calibration.load(tmp_path / "shared" / "calibration.nc")
    assert shared.data.equals(alone.data)


@pytest.mark.slow
def test_a_cluster_finds_the_same(small, tmp_path):
    """Its workers get the human model of a user's file, which they cannot import."""
    assert command(calibrate, *small, "--people", 10) == 0
    here = Calibration.load(tmp_path / "out" / "calibration.nc")
    other = [tmp_path / "there" if part == tmp_path / "out" else part for part in small]
    done = command_on_cluster(tmp_path, calibrate, *other, "--people", 10)
    assert done.returncode == 0, done.stderr
    assert Calibration.load(tmp_path / "there" / "calibration.nc").data.equals(here.data)
    assert names(tmp_path / "there") == RESULTS


def test_wrong_posteriors_end_with_status_1(small, monkeypatch, capsys):
    def narrow(human, options, network, recordings, seed):
        found = infer(human, recordings, options, seed)
        draws = {
            name: value if name == "reach" else value.mean(0) + 0.2 * (value - value.mean(0))
            for name, value in found.draws.items()
        }
        return Inferred(draws)

    monkeypatch.setattr(calibrate, "_infer", narrow)
    assert command(calibrate, *small, "--jobs", 1, "--seed", 3) == 1
    assert "rejected for 2 of 3" in capsys.readouterr().out


def test_a_stopped_run_goes_on_where_it_was(small, tmp_path, monkeypatch):
    done = []

    def counted(human, options, network, recordings, seed):
        done.append(recordings.num_people)
        if len(done) == 4:
            raise KeyboardInterrupt
        return infer(human, recordings, options, seed)

    monkeypatch.setattr(calibrate, "_infer", counted)
    assert command(calibrate, *small, "--jobs", 1) == 130
    assert names(tmp_path / "out") == {"parts"}
    assert len(list((tmp_path / "out" / "parts").iterdir())) == 3
    assert command(calibrate, *small, "--jobs", 1) == 0
    assert len(done) == 4 + 12 - 3
    assert names(tmp_path / "out") == RESULTS
    resumed = Calibration.load(tmp_path / "out" / "calibration.nc")
    other = [tmp_path / "whole" if part == tmp_path / "out" else part for part in small]
    assert command(calibrate, *other, "--jobs", 1) == 0
    assert resumed.data.equals(Calibration.load(tmp_path / "whole" / "calibration.nc").data)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--people", 0), "--people must be at least 1, not 0"),
        (("--draws", 0), "--draws must be at least 1, not 0"),
        (("--rounds", 5, 1), "--rounds must be positive and increase, not 5 1"),
        (("--rounds", 0), "--rounds must be positive and increase, not 0"),
        (("--seed", -1), "--seed must be at least 0, not -1"),
        (("--guide-file", "nowhere.x"), "--guide-file is for --guide auto and amortized"),
        (
            ("--guide", "amortized", "--human-model", "one-radius"),
            "no guide ships for one-radius in driving: train one with python -m",
        ),
        (("--jobs", 0), "--jobs must be at least 1, or -1 for all, not 0"),
        (("--guide", "magic"), 'unknown engine "magic"'),
        (("--guide", "amortized", "--guide-file", "nowhere.x"), "nowhere.x: there is no such file"),
        (("--setting", "hail"), 'unknown setting "hail"'),
        (("--domain", "sailing"), 'unknown domain "sailing"'),
        (("--human-model", "nowhere.py:Nobody"), "there is no such file"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_line(tmp_path, capsys, args, message):
    assert command(calibrate, "--out", tmp_path / "out", *args) == 2
    assert message in " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert not (tmp_path / "out").exists()

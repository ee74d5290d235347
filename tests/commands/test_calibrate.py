"""`python -m mirror_ppl.calibrate`, on toys whose posterior is quick."""

import io
from contextlib import redirect_stderr, redirect_stdout

import pytest
from PIL import Image
from running import command

from mirror_ppl.commands import calibrate
from mirror_ppl.inference.calibration.study import Calibration
from mirror_ppl.inference.engines import Inferred, infer

TOY = """from mirror_ppl.models.toy import ToyHuman


class Toy(ToyHuman):
    pass
"""
RESULTS = {"calibration.nc", "ranks.png", "ecdf.png", "coverage.png"}


def quick(folder, name="out", people=20):
    """Arguments of a quick calibration of a model of one's own."""
    path = folder / "toy.py"
    path.write_text(TOY)
    model = ("--human-model", f"{path}:Toy", "--rounds", 1, "--draws", 19, "--jobs", 1)
    return (*model, "--people", people, "--out", folder / name)


def names(folder):
    return {path.name for path in folder.iterdir()}


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A folder with a calibration of 20 people, in one go, and what the command said."""
    folder = tmp_path_factory.mktemp("whole")
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        assert command(calibrate, *quick(folder)) == 0
    return folder / "out", out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def whole(done):
    return Calibration.load(done[0] / "calibration.nc").data


def test_it_prints_and_writes_what_it_found(done):
    folder, out, err = done
    assert "20 people drawn from the prior" in out
    words = "reach", "in sight", "otherwise", "not rejected for any of 3", "calibration.nc"
    for word in (*words, "Of 20 people, only gross faults would show"):
        assert word in out
    assert "4/4 people " in err
    assert names(folder) == RESULTS
    calibration = Calibration.load(folder / "calibration.nc")
    assert calibration.people == 20 and calibration.draws == 19
    assert calibration.data.attrs["human_model"] == "Toy"
    assert calibration.data.attrs["engine"] == "importance"
    with Image.open(folder / "ranks.png") as image:
        assert len(image.convert("L").getcolors()) > 10


def test_an_engine_is_tested_with_decisions_that_count_in_full(whole, tmp_path, capsys):
    args = quick(tmp_path)
    (tmp_path / "toy.py").write_text(TOY.replace("pass", "likelihood_power = 0.25"))
    assert command(calibrate, *args) == 0
    said = capsys.readouterr().out
    assert "A decision counts once here and 0.25 times in fits of this model" in said
    found = Calibration.load(tmp_path / "out" / "calibration.nc").data
    assert found.drop_attrs().identical(whole.drop_attrs())


def test_processes_share_the_people(whole, tmp_path):
    assert command(calibrate, *quick(tmp_path), "--jobs", 2) == 0
    assert Calibration.load(tmp_path / "out" / "calibration.nc").data.equals(whole)


def test_a_cluster_finds_the_same(whole, cluster, tmp_path):
    """Its workers get the human model of a user's file, which they cannot import."""
    assert command(calibrate, *quick(tmp_path), "--scheduler", cluster) == 0
    assert Calibration.load(tmp_path / "out" / "calibration.nc").data.equals(whole)
    assert names(tmp_path / "out") == RESULTS


def test_wrong_posteriors_end_with_status_1(tmp_path, monkeypatch, capsys):
    def narrow(human, options, network, recordings, seed):
        found = infer(human, recordings, options, seed, checked=True)
        draws = {
            name: value if name == "reach" else value.mean(0) + 0.2 * (value - value.mean(0))
            for name, value in found.draws.items()
        }
        return Inferred(draws)

    monkeypatch.setattr(calibrate, "_infer", narrow)
    assert command(calibrate, *quick(tmp_path, people=60), "--seed", 3) == 1
    assert "rejected for 2 of 3" in capsys.readouterr().out


def test_a_stopped_run_goes_on_where_it_was(whole, tmp_path, monkeypatch):
    done = []

    def counted(human, options, network, recordings, seed):
        done.append(recordings.num_people)
        if len(done) == 3:
            raise KeyboardInterrupt
        return infer(human, recordings, options, seed, checked=True)

    monkeypatch.setattr(calibrate, "_infer", counted)
    assert command(calibrate, *quick(tmp_path)) == 130
    assert names(tmp_path / "out") == {"parts"}
    assert len(list((tmp_path / "out" / "parts").iterdir())) == 2
    assert command(calibrate, *quick(tmp_path)) == 0
    assert len(done) == 3 + 4 - 2
    assert names(tmp_path / "out") == RESULTS
    assert Calibration.load(tmp_path / "out" / "calibration.nc").data.equals(whole)


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
            "no guide ships for one-radius in driving: train one with python -m mirror_ppl.train "
            "--what guide --domain driving --human-model one-radius and name it with --guide-file",
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

"""Small things that are refused, or told, before they can do harm."""

import pytest
import xarray as xr

from mirror_ppl import fit, simulate, train
from mirror_ppl.data import asset_path, load_demonstrations, save_demonstrations
from mirror_ppl.errors import HumanModelError, OptionError, OutputError
from mirror_ppl.inference.self_model_training import SelfModelOptions
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.mark.parametrize("rate", [float("nan"), float("inf"), 0.0, -1.0])
@pytest.mark.parametrize(
    ("options", "error"), [(SelfModelOptions, ValueError), (train.Options, OptionError)]
)
def test_a_learning_rate_is_a_positive_number(options, error, rate):
    with pytest.raises(error, match="must be a positive number"):
        options(learning_rate=rate)


def test_a_human_model_that_exits_is_an_error_and_not_an_end(tmp_path):
    file = tmp_path / "leaving.py"
    file.write_text("import sys\nsys.exit(7)\n")
    with pytest.raises(HumanModelError, match="does not import: SystemExit: 7"):
        load_human_model(f"{file}:Leaving", None)


def test_nothing_is_simulated_for_a_file_that_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("mirror_ppl.people.simulate", None)  # calling it would fail otherwise
    with pytest.raises(OutputError):
        simulate.main(simulate.Options(out=tmp_path / "file" / "below.nc"))


def test_what_was_told_is_in_the_posterior_file(tmp_path):
    options = fit.Options(out=tmp_path, train_rounds=1, steps=2, draws=4)
    fit.main(options)
    with xr.open_dataset(tmp_path / "posterior.nc", group="constant_data") as constants:
        assert constants["told_visual"].dims[:3] == ("person", "round", "step")
        assert constants["told_verbal"].shape == (10, 1, 15, 4)
        assert not constants["told_verbal"].any()


def test_recordings_of_another_domain_than_asked_for_are_refused(tmp_path):
    recordings = asset_path("driving_fog_paper.nc")
    options = fit.Options(demos=recordings, domain="bomb_defusal", out=tmp_path / "fit")
    with pytest.raises(OptionError, match="--domain is bomb_defusal, but --demos is of driving"):
        fit.main(options)
    assert not (tmp_path / "fit").exists()


def test_a_fit_says_that_nothing_was_held_out(tmp_path, capsys):
    recordings = tmp_path / "short.nc"
    everybody = load_demonstrations(asset_path("driving_fog_paper.nc"))
    save_demonstrations(recordings, everybody.select_people([0]).select_rounds([0]))
    options = fit.Options(
        demos=recordings, domain="driving", out=tmp_path / "fit", draws=4, explore=0
    )
    fit.main(options)
    assert "No rounds were held out" in capsys.readouterr().out


def test_one_radius_is_refused_where_distances_do_not_count():
    robot, _ = load_self_model(shipped_weights("bomb_defusal"), "bomb_defusal")
    with pytest.raises(HumanModelError, match="one-radius: in bomb_defusal it does not count"):
        load_human_model("one-radius", robot)

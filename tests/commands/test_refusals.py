"""Small things that are refused, or told, before they can do harm."""

import pytest
import xarray as xr

from mirror_ppl.commands import fit, simulate, train
from mirror_ppl.data import asset_path, load_demonstrations, save_demonstrations
from mirror_ppl.errors import HumanModelError, OptionError, OutputError
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.self_model_options import SelfModelOptions

QUICK = {"human_model": "no-implants", "draws": 4, "explore": 0}


@pytest.mark.parametrize("rate", [float("nan"), float("inf"), 0.0, -1.0, 1e30])
@pytest.mark.parametrize(
    ("options", "error"), [(SelfModelOptions, ValueError), (train.Options, OptionError)]
)
def test_a_learning_rate_is_above_0_and_at_most_1(options, error, rate):
    with pytest.raises(error, match="must be above 0 and at most 1"):
        options(learning_rate=rate)


def test_a_human_model_that_exits_is_an_error_and_not_an_end(tmp_path):
    file = tmp_path / "leaving.py"
    file.write_text("import sys\nsys.exit(7)\n")
    with pytest.raises(HumanModelError, match="does not import: .*sys.exit\\(7\\)"):
        load_human_model(f"{file}:Leaving", None)


def test_nothing_is_simulated_for_a_file_that_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("mirror_ppl.people.simulate", None)  # calling it would fail otherwise
    with pytest.raises(OutputError):
        simulate.main(simulate.Options(out=tmp_path / "file" / "below.nc"))


def test_messages_are_in_the_posterior_file(tmp_path):
    options = fit.Options(out=tmp_path, people=("person-01",), train_rounds=1, **QUICK)
    fit.main(options)
    with xr.open_dataset(tmp_path / "posterior.nc", group="constant_data") as constants:
        assert constants["told_visual"].dims[:3] == ("person", "round", "step")
        assert constants["told_verbal"].shape == (1, 1, 15, 4)
        assert not constants["told_verbal"].any()


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"domain": "bomb_defusal"}, "--domain is bomb_defusal, but --demos is of driving"),
        ({"setting": "clear"}, "--setting is clear, but --demos is of fog"),
        ({"population": "papr"}, "--population is of the shipped recordings; leave it or --demos"),
    ],
)
def test_recordings_of_something_else_than_asked_for_are_refused(tmp_path, asked, message):
    recordings = asset_path("driving_fog_paper.nc")
    options = fit.Options(demos=recordings, out=tmp_path / "fit", **asked)
    with pytest.raises(OptionError, match=message):
        fit.main(options)
    assert not (tmp_path / "fit").exists()


def test_a_fit_says_that_nothing_was_held_out(tmp_path, capsys):
    recordings = tmp_path / "short.nc"
    everybody = load_demonstrations(asset_path("driving_fog_paper.nc"))
    save_demonstrations(recordings, everybody.select_people([0]).select_rounds([0]))
    options = fit.Options(demos=recordings, domain="driving", out=tmp_path / "fit", **QUICK)
    fit.main(options)
    assert "No rounds were held out" in capsys.readouterr().out


def test_one_radius_is_refused_where_distances_do_not_count():
    robot, _ = load_self_model(shipped_weights("bomb_defusal"), "bomb_defusal")
    with pytest.raises(
        HumanModelError, match="one-radius: in bomb_defusal distance does not matter"
    ):
        load_human_model("one-radius", robot)


def test_speech_is_for_worlds_in_which_something_is_put_into_words(tmp_path):
    options = train.Options(domain="driving", speech="gpt2", out=tmp_path / "own.safetensors")
    with pytest.raises(OptionError, match="--speech: nothing is put into words in driving"):
        train.main(options)
    assert not list(tmp_path.iterdir())


def test_the_supplement_s_sizes_are_trained(tmp_path, monkeypatch, capsys):
    """Its Q-network takes long to measure, which is told."""

    def quality(self_model, discount, progress):
        assert self_model.sizes.q_network == 2048
        progress(1, 2)
        progress(2, 2)
        return {"return_full": 1.0}

    monkeypatch.setattr("mirror_ppl.evaluation.self_model.self_model_quality", quality)
    small = SelfModelOptions(phases=1, rounds=2, steps=1, batch=2, length=4)
    monkeypatch.setattr(SelfModelOptions, "of", classmethod(lambda *_, **__: small))
    out = tmp_path / "paper.safetensors"
    train.main(train.Options(domain="bomb_defusal", sizes="paper", out=out))
    self_model, card = load_self_model(out, "bomb_defusal")
    assert self_model.sizes.q_network == 2048
    assert "--sizes paper" in card["command"] and card["quality"] == {"return_full": 1.0}
    assert "measure: 2/2 views" in capsys.readouterr().err

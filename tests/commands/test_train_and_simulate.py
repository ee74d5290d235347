"""`python -m mirror_ppl.train` and `simulate`: what they write can be used."""

import functools
import inspect
import re
import shlex

import pytest
from example_fits import RADIUS, RESULTS_OF_RADIUS, content
from running import command

from mirror_ppl.commands import fit, simulate, train
from mirror_ppl.console import command_line
from mirror_ppl.data import load_demonstrations
from mirror_ppl.evaluation import self_model as evaluation
from mirror_ppl.models.weights import load_self_model
from mirror_ppl.training.self_model_options import SelfModelOptions


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


@pytest.mark.parametrize("name", ["phases", "steps", "learning_rate"])
def test_the_help_has_the_defaults_of_each_world(name):
    source = inspect.getsource(train.Options)
    text = " ".join(re.search(rf'    {name}: .*?"""(.*?)"""', source, re.DOTALL)[1].split())
    shown = dict(re.findall(r"of (\w+) (\d+(?:\.\d+)?)", text))
    worlds = ("driving", "search_rescue", "bomb_defusal", "highway")
    assert shown == {world: f"{getattr(SelfModelOptions.of(world), name):g}" for world in worlds}


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


def test_a_card_shows_a_dash_for_what_could_not_be_measured(capsys):
    quality = {"share_full": None, "return_full": float("nan"), "agreement_full": 0.5}
    train._show({"command": "train", "quality": quality})
    shown = capsys.readouterr().out
    assert shown.count(" - ") == 2 and "0.500" in shown


def test_recorded_commands_are_quoted():
    found = command_line(
        "python -m mirror_ppl.fit", {"human_model": "my models/a.py:A", "seed": None}
    )
    assert shlex.split(found)[-2:] == ["--human-model", "my models/a.py:A"] and "seed" not in found

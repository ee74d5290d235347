"""Weights of self-models: files, and how good those are that ship."""

import json
import math

import pytest
import torch
from safetensors.torch import save_file

from mirror_ppl.domains import get_domain
from mirror_ppl.domains.driving import Driving
from mirror_ppl.errors import AssetError
from mirror_ppl.evaluation.self_model import (
    fixed_views,
    planner_actions,
    returns,
    self_model_quality,
)
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import Sizes
from mirror_ppl.models.weights import load_self_model, save_self_model, shipped_weights
from mirror_ppl.training.experience import drive

DRIVING = get_domain("driving")
STEPS = DRIVING.horizon


@pytest.fixture(scope="module")
def shipped():
    return load_self_model(shipped_weights("driving"), "driving")


CARD = {"command": "test", "quality": {"share": 0.98}}


def test_weights_survive_a_round_trip(tmp_path):
    path, model = tmp_path / "a.safetensors", SelfModel(DRIVING)
    save_self_model(model, path, CARD)
    state = torch.random.get_rng_state()
    loaded, card = load_self_model(path, "driving")
    assert torch.equal(torch.random.get_rng_state(), state)
    for name, value in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value)
    assert card == CARD
    assert not loaded.training
    assert loaded.domain is DRIVING
    assert [part.name for part in tmp_path.iterdir()] == ["a.safetensors"]


def test_damaged_weights_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    with pytest.raises(AssetError, match=r"a\.safetensors: there is no such file"):
        load_self_model(path)
    save_self_model(SelfModel(DRIVING), path, CARD)
    content = path.read_bytes()
    for damaged in (content[:-1], content[:100], b"", b"nonsense" * 20):
        path.write_bytes(damaged)
        with pytest.raises(AssetError, match=r"a\.safetensors: cannot be read"):
            load_self_model(path)


def test_weights_of_something_else_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.safetensors"
    save_file({"x": torch.zeros(2)}, path)
    with pytest.raises(AssetError, match="not a self-model"):
        load_self_model(path)
    broken = SelfModel(DRIVING)
    broken.sizes = Sizes(latent=8)
    save_self_model(broken, path, CARD)
    with pytest.raises(AssetError, match="does not fit this program"):
        load_self_model(path)
    save_self_model(SelfModel(DRIVING), path, CARD)
    with pytest.raises(AssetError, match='is for the domain "driving", not "bomb"'):
        load_self_model(path, "bomb")
    monkeypatch.setattr(Driving, "version", "2")
    with pytest.raises(AssetError, match="is for version 1 of driving, this is version 2"):
        load_self_model(path)
    monkeypatch.undo()
    monkeypatch.setattr(Driving, "name", "flying")
    save_self_model(SelfModel(DRIVING), path, CARD)
    monkeypatch.undo()
    with pytest.raises(AssetError, match='unknown domain "flying"'):
        load_self_model(path)


def test_weights_know_their_sizes(tmp_path):
    path, sizes = tmp_path / "a.safetensors", Sizes(latent=8, encoder=16)
    save_self_model(SelfModel(DRIVING, sizes), path, CARD)
    model, _ = load_self_model(path)
    assert (model.sizes, model.latent, model.encoder.ego.out_features) == (sizes, 8, 16)


def test_weights_hold_bins_of_values(tmp_path):
    path = tmp_path / "a.safetensors"
    sizes = Sizes(value_bins=3, least_value=-3, most_value=1)
    saved = SelfModel(DRIVING, sizes)
    save_self_model(saved, path, CARD)
    model, _ = load_self_model(path)
    assert model.q_network.centres.tolist() == [-9, -7, -5, -3, -1, 1, 3, 5, 7]
    z = torch.randn(3, model.latent)
    torch.testing.assert_close(model.action_values(z), saved.action_values(z))


def test_no_weights_ship_for_an_unknown_domain():
    with pytest.raises(AssetError, match="there is no self-model of bomb yet"):
        shipped_weights("bomb")


# --- how good the shipped weights are ---------------------------------------------------------


def test_shipped_weights_drive_well_in_clear_view(shipped):
    model, rounds = shipped[0], 4000
    generator = torch.Generator().manual_seed(77)
    start = DRIVING.initial(rounds, generator)
    anything = torch.randint(2, (rounds, STEPS), generator=generator)
    best = returns(DRIVING, start, planner_actions(DRIVING, start, STEPS, 1.0))
    own = drive(model, start, fixed_views(DRIVING, rounds, generator), STEPS, generator)
    reached = returns(DRIVING, start, own)
    assert (reached <= best + 1e-4).all()  # the yardstick is the optimum of every round
    gap = (best - returns(DRIVING, start, anything)).mean()
    regret = (best - reached) / gap
    share = 1 - regret.mean().item()
    # One in 20,000 runs of a model of exactly 98% would end below this.
    assert share >= 0.98 - 4 * regret.std().item() / math.sqrt(rounds)


def test_shipped_weights_are_as_good_as_their_card_says(shipped):
    model, card = shipped
    number, of_card = 800, 4000
    assert card["quality"]["share_clear"] >= 0.98
    assert json.loads(json.dumps(card)) == card
    measured = self_model_quality(model, number, seed=78)
    agreements = [name for name in card["quality"] if "agreement" in name]
    assert len(agreements) == 8
    for name in agreements:
        stated = card["quality"][name]
        # Decisions of one round go together: the error is at most that of whole rounds.
        error = math.sqrt(stated * (1 - stated) * (1 / number + 1 / of_card))
        assert measured[name] >= stated - 4 * error, name


def test_a_world_in_which_actions_do_not_matter_has_no_share_of_the_best(shipped, monkeypatch):
    def nothing(self, state, action, following):
        return {"nothing": torch.zeros(action.shape)}

    monkeypatch.setattr(Driving, "rewards", nothing)
    measured = self_model_quality(shipped[0], 3, seed=0)
    assert measured["return_full"] == measured["return_random"] == measured["return_exact"] == 0
    assert not any(name.startswith("share") for name in measured)

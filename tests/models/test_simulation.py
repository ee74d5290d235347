"""Rounds as modelled people would play them: what follows from what, and their ends."""

import pytest
import torch
from example_course import gone_through
from example_person import Averaging, Unused

from mirror_ppl.domains import get_domain
from mirror_ppl.models import HumanModel
from mirror_ppl.models.implants import RESIDUAL_HIDDEN, sight_sites
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


def test_a_memory_that_is_not_used_leaves_rounds_as_they_are(self_model):
    implants = {"sight_front_own": torch.tensor([[3], [6]])}
    one, other = (
        play_rounds(kind(self_model), implants, 12, "fog", torch.Generator().manual_seed(2))
        for kind in (HumanModel, Unused)
    )
    assert torch.equal(one.actions, other.actions)
    assert one.equals(other)
    assert 0.05 < one.actions.float().mean() < 0.5


@pytest.mark.parametrize("kind", [HumanModel, Averaging])
def test_actions_are_those_of_beliefs_along_whole_rounds(self_model, kind):
    """Of two people who always do what they think best."""
    human, rounds = kind(self_model), 12
    implants = {site: torch.zeros(2, 1, dtype=torch.long) for site in sight_sites(human.domain)}
    implants |= {"sight_front_own": torch.tensor([[3], [6]])}
    implants |= {"assumes_clear": torch.tensor([[1], [0]]), "assumes_closing": torch.ones(2, 1)}
    implants |= {"consistency": torch.full((2, 1), 1e4), "lapse": torch.full((2, 1), 1e-6)}
    implants |= {"residual_in": torch.zeros(2, 1, self_model.latent + 1, RESIDUAL_HIDDEN)}
    implants |= {"residual_out": torch.zeros(2, 1, RESIDUAL_HIDDEN + 1, 2)}
    played = play_rounds(human, implants, rounds, "fog", torch.Generator().manual_seed(2))
    steps = played.shape[2]
    observation = {name: value[:, :, :steps] for name, value in played.observation().items()}
    told = {name: torch.zeros_like(mask) for name, mask in played.told.items()}
    eyes = {name: value for name, value in implants.items() if name.split("_")[0] != "residual"}
    belief = gone_through(human, eyes, observation, told, played.actions).flatten(1, 2)
    chances = human.act(implants, belief, human.action_values(belief)).exp()
    done = chances.gather(-1, played.actions.flatten(1)[..., None])
    assert done.mean() > 0.99
    # What the other action would have been is clear, too, and which it is differs.
    assert 0.05 < played.actions.float().mean() < 0.5


@pytest.mark.parametrize("kind", [HumanModel, Averaging])
def test_rounds_end_when_all_is_done(kind, monkeypatch):
    domain = get_domain("search_rescue")
    torch.manual_seed(0)
    human = kind(SelfModel(domain))
    monkeypatch.setattr(type(domain), "horizon", 6)
    # All is done as soon as they stand in another row than at the beginning.
    monkeypatch.setattr(type(domain), "over", lambda self, state: state.place[..., 0] < 8)
    implants = {"sight_radius": torch.tensor([[2], [33]])}
    played = play_rounds(human, implants, 20, "smoke", torch.Generator().manual_seed(0))
    assert played.lengths.unique().numel() > 2
    for person in range(2):
        for number in range(20):
            rows = played.ego[person, number, :, 0]
            length = int(played.lengths[person, number])
            assert (rows[:length] == 8).all() or length == 6
            assert length == 6 or float(rows[length]) < 8
            assert (played.actions[person, number, length:] == -1).all()

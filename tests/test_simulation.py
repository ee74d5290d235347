"""Rounds as modelled people would play them: either way of going through them, and their ends."""

import pytest
import torch

from mirror_ppl.domains import get_domain
from mirror_ppl.inference.simulation import play_rounds
from mirror_ppl.models import HumanModel
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.weights import load_self_model, shipped_weights


class NotStepwise(HumanModel):
    """The same people, gone through from the beginning of a round at each step."""

    stepwise = False


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


def test_both_ways_play_the_same_rounds(self_model):
    implants = {"sight_front_own": torch.tensor([[3], [6]])}
    one, other = (
        play_rounds(kind(self_model), implants, 12, "fog", torch.Generator().manual_seed(2))
        for kind in (HumanModel, NotStepwise)
    )
    assert torch.equal(one.actions, other.actions)
    assert one.equals(other)
    assert 0.05 < one.actions.float().mean() < 0.5


@pytest.mark.parametrize("kind", [HumanModel, NotStepwise])
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

"""Rounds as modelled people would play them: what follows from what, and their ends."""

import pytest
import torch
from example_course import gone_through
from example_person import Averaging, Unused

from mirror_ppl.data.contradictions import check_world
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import InputError, UnknownNameError
from mirror_ppl.models import HumanModel
from mirror_ppl.models.implants import RESIDUAL_HIDDEN, sight_sites
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior_of_each
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.simulation import play_rounds, simulate_from_prior
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
    """Two people who nearly always choose the best action act on their beliefs at each step."""
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
    probabilities = human.act(implants, belief, human.action_values(belief)).exp()
    done = probabilities.gather(-1, played.actions.flatten(1)[..., None])
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


@pytest.mark.parametrize("world", ["driving", "search_rescue", "bomb_defusal"])
def test_people_of_the_prior_come_with_their_truth(world):
    human = load_human_model("all", load_self_model(shipped_weights(world), world)[0])
    domain = human.domain
    found = simulate_from_prior(human, 3, 2, seed=5, told=0.5)
    drawn = draw_prior_of_each(human, ["person-01", "person-02", "person-03"], 1, 5)
    scalars = {name for name, value in drawn.items() if value.dim() == 3}
    assert set(found.truth) == scalars and found.shape[:2] == (3, 2)
    assert found.setting == domain.settings[-1]
    for name, value in found.truth.items():
        own = drawn[name][0, :, 0]
        bins = torch.tensor(domain.reach_bins)
        expected = bins[own] if name.startswith("sight_") else own.float()
        assert torch.equal(value, expected), name
    assert found.provenance["population"] == f"prior of {type(human).__name__}"
    assert found.provenance["seed"] == 5 and found.provenance["told"] == 0.5
    entropy = found.action_entropy[found.mask]
    assert (entropy >= 0).all() and (
        entropy <= torch.tensor(len(domain.actions)).log() + 1e-5
    ).all()
    check_world(found, 0.0)
    # Half of what can be communicated is, and nothing else.
    steps = found.shape[2]
    now = {name: value[:, :, :steps] for name, value in found.observation().items()}
    can_be = domain.communicable(now)
    told = torch.cat([(mask & found.mask[..., None]).flatten() for mask in found.told.values()])
    could = torch.cat([(mask & found.mask[..., None]).flatten() for mask in can_be.values()])
    assert not (told & ~could).any()
    assert abs(float(told.sum() / could.sum()) - 0.5) < 4 * 0.5 / float(could.sum()) ** 0.5
    silent = simulate_from_prior(human, 3, 2, seed=5)
    assert not any(mask.any() for mask in silent.told.values()) and "told" not in silent.provenance


def test_entropy_is_that_of_the_choice(self_model):
    """A person throws a coin at every step."""
    human = HumanModel(self_model)
    known = {"consistency": torch.full((2, 1), 1e-6), "lapse": torch.tensor([[0.5], [0.999]])}
    known |= {"residual_out": torch.zeros(2, 1, RESIDUAL_HIDDEN + 1, 2)}
    played = play_rounds(human, known, 3, "fog", torch.Generator().manual_seed(1))
    torch.testing.assert_close(
        played.action_entropy[played.mask], torch.full((90,), 2.0).log(), atol=1e-4, rtol=0
    )


def test_who_cannot_be_drawn_is_refused(self_model):
    human = HumanModel(self_model)
    for arguments, message in (
        ((0, 1), "people must be at least 1"),
        ((1, 0), "rounds must be at least 1"),
    ):
        with pytest.raises(InputError, match=message):
            simulate_from_prior(human, *arguments)
    with pytest.raises(InputError, match="told"):
        simulate_from_prior(human, 1, 1, told=2.0)
    with pytest.raises(UnknownNameError, match="smoke"):
        simulate_from_prior(human, 1, 1, "smoke")

"""Views that the self-model is trained under: how often each kind comes, and what it shows."""

import math

import pytest
import torch

from mirror_ppl.domains import get_domain
from mirror_ppl.domains.base import roll_out
from mirror_ppl.domains.driving import DrivingState
from mirror_ppl.training.views import KIND_PROBABILITIES, TOLD_PROBABILITY, draw_views

DRIVING = get_domain("driving")
STEPS = DRIVING.horizon


def standard_error(share, number):
    return math.sqrt(share * (1 - share) / number)


@pytest.fixture(scope="module")
def many_views():
    """20,000 views of one course of a round, with the plan they come from."""
    generator = torch.Generator().manual_seed(11)
    plan = draw_views(DRIVING, 20_000, STEPS, generator)
    # A slow car 3 cells ahead, and one 2 cells behind in the other lane.
    start = DrivingState(
        torch.zeros(20_000, dtype=torch.long),
        torch.tensor([3, 11, -11, -2]).expand(20_000, 4),
        torch.tensor([-1, 1, -1, -1]).expand(20_000, 4),
    )
    states = roll_out(DRIVING, start, torch.zeros(20_000, STEPS, dtype=torch.long))
    observation = DRIVING.observe(states)
    return plan, observation, plan.visibility(DRIVING, observation)


def kinds(plan):
    """Which views are full, dropout and sight; told apart by what they keep of either modality."""
    visual, verbal = plan.keep["visual"], plan.keep["verbal"]
    return (visual == 1) & (verbal == 1), visual < 1, (visual == 1) & (verbal == 0)


def test_kinds_of_views_come_as_often_as_stated(many_views):
    plan, _, _ = many_views
    full, dropout, sight = kinds(plan)
    assert torch.equal(full.long() + dropout.long() + sight.long(), torch.ones(20_000).long())
    for kind, share in zip((full, dropout, sight), KIND_PROBABILITIES, strict=True):
        error = standard_error(share, 20_000)
        assert kind.float().mean().item() == pytest.approx(share, abs=4 * error)
    number = int(sight.sum())
    assert torch.equal(plan.remembers, sight)
    spoken_to = plan.told["visual"] > 0
    assert not spoken_to[~sight].any()
    assert torch.equal(spoken_to, plan.told["verbal"] > 0)
    error = standard_error(TOLD_PROBABILITY, number)
    assert spoken_to[sight].float().mean().item() == pytest.approx(TOLD_PROBABILITY, abs=4 * error)
    # Each reach is equally likely in each direction; only sight is limited.
    assert (plan.reach[~sight] == DRIVING.reach_bins[-1]).all()
    bins = len(DRIVING.reach_bins)
    for edge in DRIVING.reach_bins:
        share = (plan.reach[sight] == edge).float().mean(0)
        assert (share - 1 / bins).abs().max() < 4.5 * standard_error(1 / bins, number)


def test_full_views_show_and_communicate_everything(many_views):
    plan, _, visible = many_views
    full, _, _ = kinds(plan)
    assert visible["visual"][full].all()
    assert visible["verbal"][full].all()


def test_dropout_views_keep_each_item_at_the_rate_of_the_round(many_views):
    plan, _, visible = many_views
    _, dropout, _ = kinds(plan)
    for name in ("visual", "verbal"):
        kept = visible[name][dropout].float()
        rate = plan.keep[name][dropout]
        number = kept[0].numel()
        # Standardized by round; their squares average to one, with a standard error of at most
        # sqrt(3 / n), as the kurtosis is at most that of the rarest rate tried.
        middle = (rate > 0.1) & (rate < 0.9)
        error = (rate * (1 - rate) / number).sqrt()
        standardized = ((kept.mean((1, 2)) - rate) / error)[middle]
        count = len(standardized)
        assert standardized.mean().abs().item() < 4 / math.sqrt(count)
        assert standardized.square().mean().item() == pytest.approx(
            1.0, abs=4 * math.sqrt(3 / count)
        )
    # Of the two modalities, each has a rate of its own.
    rates = torch.stack([plan.keep[name][dropout] for name in ("visual", "verbal")])
    assert torch.corrcoef(rates)[0, 1].abs().item() < 4 / math.sqrt(rates.shape[1])


def test_sight_views_show_cars_within_reach_and_communicated_items(many_views):
    plan, observation, visible = many_views
    _, _, sight = kinds(plan)
    direction, distance = DRIVING.distance(observation)
    near = distance <= plan.reach[torch.arange(20_000)[:, None, None], direction]
    quiet = sight & (plan.told["visual"] == 0)
    assert torch.equal(visible["visual"][quiet], near[quiet])
    assert not visible["verbal"][quiet].any()
    spoken_to = sight & (plan.told["visual"] > 0)
    allowed = DRIVING.communicable(observation)
    assert not (visible["verbal"] & ~allowed["verbal"])[spoken_to].any()
    assert (visible["visual"] | ~near)[spoken_to].all()
    extra = (visible["visual"] & ~near)[spoken_to]
    assert not (extra & ~allowed["visual"][spoken_to]).any()
    # As often as stated, over all occasions to tell: the rate of a round is at most one half.
    for name in ("visual", "verbal"):
        rate = plan.told[name][spoken_to]
        assert rate.max() <= 0.5
        occasions = allowed[name] & ~near if name == "visual" else allowed[name]
        occasions = occasions[spoken_to].flatten(1).sum(1)
        told = (extra if name == "visual" else visible[name][spoken_to]).flatten(1).sum(1)
        variance = (occasions * rate * (1 - rate)).sum()
        assert (told - occasions * rate).sum().abs() < 4 * variance.sqrt()


def test_a_plan_says_the_same_of_each_step_by_itself(many_views):
    plan, observation, visible = many_views
    for step in (0, 7, STEPS):
        now = {name: value[:, step : step + 1] for name, value in observation.items()}
        alone = plan.visibility(DRIVING, now, first=step)
        for name, mask in visible.items():
            assert torch.equal(alone[name], mask[:, step : step + 1])

"""Inverse reinforcement learning: closed forms first, then known weights from simulated choices."""

import math

import pytest
import torch

from mirror_ppl.domains.driving.maximum_entropy import FEATURES, Decisions, learn_reward, log_policy
from mirror_ppl.errors import DemonstrationsError

HORIZON, DISCOUNT = 10, 0.9
# Centre, cars at 0 to 4 cells, switch.
TRUE = torch.tensor([0.0, -5.0, -3.0, -2.0, -1.0, 0.5, -1.5], dtype=torch.float64)


def empty_road(switches, stays):
    actions = torch.tensor([1] * switches + [0] * stays)
    nothing = torch.zeros(len(actions), 4)
    return Decisions(torch.zeros_like(actions), nothing.bool(), nothing, nothing, actions)


def random_decisions(number, generator):
    """Beliefs all over the road, and choices by the policy of the true weights."""

    def draw(lowest, highest):
        return torch.randint(lowest, highest, (number, 4), generator=generator)

    decisions = Decisions(
        lane=draw(0, 2)[:, 0],
        known=draw(0, 4) > 0,
        position=draw(-8, 9).float(),
        speed=2.0 * draw(0, 2) - 1,
        action=torch.zeros(number, dtype=torch.long),
    )
    probability = log_policy(TRUE, decisions, HORIZON, DISCOUNT).exp()[:, 1]
    action_noise = torch.rand(number, generator=generator)
    decisions.action[:] = (action_noise < probability).long()
    return decisions


@pytest.fixture(scope="module")
def many():
    return random_decisions(6000, torch.Generator().manual_seed(7))


@pytest.fixture(scope="module")
def learned(many):
    return learn_reward(many, HORIZON, DISCOUNT)


# --- the policy -------------------------------------------------------------------------------


def test_without_wishes_both_actions_are_equally_likely(many):
    logs = log_policy(torch.zeros(7), many, HORIZON, DISCOUNT)
    assert torch.allclose(logs, torch.tensor(0.5).log())


@pytest.mark.parametrize("switch", [-3.0, -1.0, 0.7])
def test_on_an_empty_road_only_the_switch_counts(switch):
    # What follows is the same in both lanes, so that Q(switch) - Q(stay) is the switch's weight.
    weights = torch.tensor([0.3, -5.0, -4.0, -3.0, -2.0, -1.0, switch])
    probability = log_policy(weights, empty_road(1, 0), HORIZON, DISCOUNT).exp()
    expected = 1 / (1 + math.exp(-switch))
    assert probability[0].tolist() == pytest.approx([1 - expected, expected], rel=1e-5)


@pytest.mark.parametrize("distance", [0, 1, 4, 5])
@pytest.mark.parametrize("side", [-1, 1])
def test_one_step_ahead_the_car_that_comes_near_counts(distance, side):
    # The front-left car will be at this distance, which is that of staying in the left lane.
    speed = -1.0
    place = torch.tensor([[side * distance - speed, 0.0, 0.0, 0.0]])
    moves = torch.tensor([[speed, 0.0, 0.0, 0.0]])
    known = torch.tensor([[True, False, False, False]])
    lane = torch.tensor([0])
    decision = Decisions(lane, known, place, moves, lane)
    logs = log_policy(TRUE, decision, 1, DISCOUNT)
    near = TRUE[1 + distance] if distance < 5 else 0.0
    assert (logs[0, 1] - logs[0, 0]).item() == pytest.approx(float(TRUE[-1] - near))


def test_a_car_in_the_other_lane_deters_from_going_there():
    place, moves = torch.tensor([[2.0, 2.0, 0.0, 0.0]]), -torch.ones(1, 4)
    lane = torch.tensor([0])
    for car, sign in ((0, 1), (1, -1)):
        known = torch.arange(4) == car
        logs = log_policy(TRUE, Decisions(lane, known[None], place, moves, lane), 5, DISCOUNT)
        empty = log_policy(TRUE, Decisions(lane, known[None] & False, place, moves, lane), 5, 0.9)
        assert sign * (logs[0, 1] - empty[0, 1]) > 0


def test_every_weight_but_the_centre_s_has_a_gradient(many):
    weights = TRUE.clone().requires_grad_()
    chosen = log_policy(weights, many, HORIZON, DISCOUNT).gather(-1, many.action[:, None])
    chosen.sum().backward()
    gradient = weights.grad
    # Relative to the 6,000 terms that the others are sums of.
    assert abs(gradient[0]) < 1e-8
    assert (gradient[1:].abs() > 1e-3).all()


def test_gradient_agrees_with_finite_differences(generator):
    few = random_decisions(5, generator)
    weights = TRUE.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda w: log_policy(w, few, HORIZON, DISCOUNT), weights)


# --- learning ---------------------------------------------------------------------------------


def test_on_an_empty_road_the_switch_s_weight_is_the_log_odds():
    # The maximum of the likelihood is where the odds of switching are those observed: 120 to 880.
    # The prior moves it by weight / (prior_scale**2 * information), which is 2e-5 here.
    reward = learn_reward(empty_road(120, 880), HORIZON, DISCOUNT)
    assert reward.scale == pytest.approx(math.log(880 / 120), abs=1e-4)
    # The standard error of log-odds.
    assert reward.scale_error == pytest.approx((1 / 120 + 1 / 880) ** 0.5, rel=1e-3)
    assert reward.switch == -1.0
    assert reward.standard_errors["switch"] == 0.0
    # Of all the others nothing is learned: prior mean, prior standard deviation.
    for name in FEATURES[:-1]:
        assert reward.weights[name] == pytest.approx(0.0, abs=1e-6)
        assert reward.standard_errors[name] == pytest.approx(30 / reward.scale, rel=1e-3)


def test_known_weights_are_recovered(learned):
    # Seven comparisons at 4 standard errors: one in 2,000 such tests fails by chance.
    scale = -TRUE[-1].item()
    assert abs(learned.scale - scale) < 4 * learned.scale_error
    for name, weight in zip(FEATURES, (TRUE / scale).tolist(), strict=True):
        error = learned.standard_errors[name]
        assert abs(learned.weights[name] - weight) <= 4 * error, name
        if name != "centre_distance":
            assert error < 0.35, "so precise that the comparison means something"


def test_the_centre_s_weight_stays_at_its_prior(learned):
    assert learned.weights["centre_distance"] == pytest.approx(0.0, abs=1e-6)
    assert learned.standard_errors["centre_distance"] == pytest.approx(30 / learned.scale)


def test_learning_is_deterministic(many, learned):
    assert learn_reward(many, HORIZON, DISCOUNT) == learned


def test_weights_of_cars_are_those_of_the_features(learned):
    weights = learned.car_weights()
    assert weights.tolist() == pytest.approx([learned.weights[f"car_at_{n}"] for n in range(5)])


def test_switching_that_costs_nothing_cannot_set_the_scale():
    with pytest.raises(DemonstrationsError, match="switching"):
        learn_reward(empty_road(700, 300), HORIZON, DISCOUNT)

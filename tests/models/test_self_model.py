"""The self-model: its bound, and its experience worked out by hand."""

from dataclasses import replace

import pytest
import torch
from example_experience import STAY4, two_cars_near
from pyro import poutine
from pyro.infer import Trace_ELBO
from torch.distributions import Normal

from mirror_ppl.domains import get_domain
from mirror_ppl.domains.driving import ROAD_END
from mirror_ppl.evaluation.self_model import (
    TIE,
    _agreement,
    exact_values,
    fixed_views,
    robot_values,
)
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.experience import Course, drive, experience
from mirror_ppl.training.self_model_loss import self_model_loss
from mirror_ppl.training.self_model_options import SelfModelOptions
from mirror_ppl.training.views import draw_views

DRIVING = get_domain("driving")
STEPS = DRIVING.horizon


@pytest.fixture(scope="module")
def shipped():
    return load_self_model(shipped_weights("driving"), "driving")


@pytest.fixture
def lived(generator):
    """Experience of 40 rounds, each seen in a way of its own."""
    start = DRIVING.initial(40, generator)
    actions = torch.randint(2, (40, STEPS), generator=generator)
    return experience(
        DRIVING, Course.of(DRIVING, start, actions), draw_views(DRIVING, 40, STEPS, generator)
    )


# --- the bound --------------------------------------------------------------------------------


def test_elbo_equals_that_of_pyro_and_so_does_its_gradient(lived):
    model, rounds = SelfModel(DRIVING), lived.rounds
    torch.manual_seed(1)
    ours, _ = model.elbo(rounds)
    ours.backward()
    gradients = [part.grad.clone() for part in model.encoder.parameters()]
    model.zero_grad()
    torch.manual_seed(1)
    theirs = Trace_ELBO().differentiable_loss(model.model, model.guide, rounds)
    theirs.backward()
    torch.testing.assert_close(ours, -theirs, rtol=1e-5, atol=0.0)
    for gradient, part in zip(gradients, model.encoder.parameters(), strict=True):
        torch.testing.assert_close(gradient, -part.grad, rtol=1e-3, atol=1e-2)


def test_elbo_is_the_sum_of_log_densities(lived):
    # In the released MIRROR code the divergence was averaged over latent dimensions while the
    # reconstruction was summed, and the first state had no prior.
    model, rounds = SelfModel(DRIVING), lived.rounds
    bound, z = model.elbo(rounds)
    actions = rounds.actions
    total = Normal(0.0, 1.0).log_prob(z[:, 0]).sum()
    total += Normal(*model.transition(z[:, :-1], actions)).log_prob(z[:, 1:]).sum()
    scales = {"visual": (12.0, 1.0), "verbal": (12.0, 1.0, 1.0)}
    for name, scale in scales.items():
        target = rounds.observation[name] / torch.tensor(scale)
        total += Normal(*model.decoders[name](z)).log_prob(target).sum()
    lane = rounds.observation["ego"][..., None, :]
    total += Normal(*model.decoders["ego"](z)).log_prob(lane).sum()
    total += Normal(*model.reward(z[:, :-1], actions)).log_prob(rounds.rewards).sum()
    evidence = model.evidence(rounds.observation, rounds.visible, actions)
    nothing = torch.zeros(len(actions), model.latent)
    total -= Normal(*model.encoder(nothing, evidence[:, 0])).log_prob(z[:, 0]).sum()
    total -= Normal(*model.encoder(z[:, :-1], evidence[:, 1:])).log_prob(z[:, 1:]).sum()
    assert bound.item() == pytest.approx(total.item(), rel=1e-5)


def test_targets_are_unmasked(lived):
    model = SelfModel(DRIVING)
    hidden = {name: torch.zeros_like(mask) for name, mask in lived.rounds.visible.items()}
    nodes = poutine.trace(model.model).get_trace(replace(lived.rounds, visible=hidden)).nodes
    observation = lived.rounds.observation
    for name, scale in {"visual": (12.0, 1.0), "verbal": (12.0, 1.0, 1.0)}.items():
        assert nodes[f"x_{name}"]["is_observed"]
        assert torch.equal(nodes[f"x_{name}"]["value"], observation[name] / torch.tensor(scale))
    assert torch.equal(nodes["x_ego"]["value"][..., 0, :], observation["ego"])


@pytest.mark.parametrize("on_means", [False, True])
def test_every_parameter_learns_from_the_loss(lived, on_means):
    model, target = SelfModel(DRIVING), SelfModel(DRIVING).q_network
    self_model_loss(model, target, lived, SelfModelOptions(), on_means).total.backward()
    for name, part in model.named_parameters():
        assert part.grad is not None, name
        assert part.grad.abs().max() > 0, name
    assert all(part.grad is None for part in target.parameters())


# --- experience, by hand ----------------------------------------------------------------------


def test_outcomes_of_both_actions_in_full_view():
    plan = fixed_views(DRIVING, 1, torch.Generator(), speech=True)
    lived = experience(DRIVING, Course.of(DRIVING, two_cars_near(), STAY4), plan)
    rounds, (stay, switch) = lived.rounds, lived.outcomes
    # Car ahead at 2, 1, 0, -1 cells: -2 each time, and -5 in the same cell.
    assert stay.reward.tolist() == [[-2.0, -2.0, -7.0, -2.0]]
    assert torch.equal(rounds.rewards, stay.reward)
    # At right the car behind is 3, 4, 5, 6 cells away: only the switch costs.
    assert switch.reward.tolist() == [[-1.0, -1.0, -1.0, -1.0]]
    assert stay.observation["visual"][0, :, 0, 0].tolist() == [2, 1, 0, -1]
    assert switch.observation["visual"][0, :, 0, 0].tolist() == [2, 1, 0, -1]
    assert rounds.observation["visual"][0, :, 3, 0].tolist() == [-2, -3, -4, -5, -6]
    assert stay.observation["ego"].flatten().tolist() == [0, 0, 0, 0]
    assert switch.observation["ego"].flatten().tolist() == [1, 1, 1, 1]
    # Seen from the other lane, offsets turn round.
    assert stay.observation["visual"][0, 0, :, 1].tolist() == [0, 1, 0, 1]
    assert switch.observation["visual"][0, 0, :, 1].tolist() == [-1, 0, -1, 0]
    assert all(mask.all() for mask in rounds.visible.values())
    assert all(mask.all() for outcome in lived.outcomes for mask in outcome.visible.values())


@pytest.mark.parametrize("assuming", [True, False])
def test_world_of_a_person_who_sees_one_cell_ahead(assuming):
    plan = fixed_views(DRIVING, 1, torch.Generator(), (1.0, 0.0, 0.0, 0.0))
    assert list(plan.assumes) == ["clear", "closing"] and all(plan.assumes.values())
    plan = replace(plan, assumes=dict.fromkeys(plan.assumes, torch.tensor([assuming])))
    lived = experience(DRIVING, Course.of(DRIVING, two_cars_near(), STAY4), plan)
    rounds, (stay, switch) = lived.rounds, lived.outcomes
    ahead = rounds.observation["visual"][0, :, 0, 0]
    # Seen at 1 cell and again at 0; from then on the car is known, in sight or not.
    visual, verbal = (
        [rounds.visible[name][0, :, 0].tolist(), stay.visible[name][0, :, 0].tolist()]
        for name in ("visual", "verbal")
    )
    if assuming:
        # Never seen at 3 and 2 cells: not there. Seen once, it is taken to come closer.
        assert ahead.tolist() == [ROAD_END, ROAD_END, 1, 0, -1]
        assert visual == [[True] * 5, [True] * 4]
        assert verbal == [[False, False, True, True, True], [False, False, True, True]]
        assert rounds.observation["verbal"][0, :, 0, 2].tolist() == [0, 0, -1, -1, -1]
        # The car at 1 cell surprised them: to the best knowledge before, there was none.
        assert rounds.rewards.tolist() == [[0.0, 0.0, -7.0, -2.0]]
        assert stay.observation["visual"][0, :, 0, 0].tolist() == [ROAD_END, ROAD_END, 0, -1]
        # The other cars are never seen.
        assert (rounds.observation["visual"][0, :, 1:, 0] == ROAD_END).all()
        assert rounds.visible["visual"][0, :, 1:].all()
    else:
        assert ahead.tolist() == [3, 2, 1, 0, -1]
        assert visual == [[False, False, True, True, True], [False, True, True, True]]
        assert verbal == [[False, False, False, True, True], [False, False, True, True]]
        assert rounds.rewards.tolist() == [[-2.0, -2.0, -7.0, -2.0]]
        assert not rounds.visible["visual"][0, :, 1:].any()
    assert torch.equal(stay.reward, rounds.rewards)
    assert switch.reward.tolist() == [[-1.0, -1.0, -1.0, -1.0]]
    assert not rounds.visible["verbal"][0, :, 1:].any()


def test_people_know_communicated_items_from_then_on(generator):
    plan = fixed_views(DRIVING, 1, generator, (0.0, 0.0, 0.0, 0.0))
    plan.noise["verbal"][..., 1] = 1.0
    plan.noise["verbal"][0, 1, 0, 1] = 0.0  # the car ahead is spoken of at step 1
    told = {"visual": torch.zeros(1), "verbal": torch.full((1,), 0.5)}
    rounds = experience(
        DRIVING, Course.of(DRIVING, two_cars_near(), STAY4), replace(plan, told=told)
    ).rounds
    assert rounds.observation["visual"][0, :, 0, 0].tolist() == [ROAD_END, 2, 1, 0, -1]
    assert rounds.observation["verbal"][0, :, 0, 2].tolist() == [0, -1, -1, -1, -1]
    # Before, it was taken to be absent, of which there is no word.
    assert rounds.visible["verbal"][0, :, 0].tolist() == [False, True, True, True, True]
    assert rounds.visible["visual"].all()
    # To a person who does not remember, speech is only of the step at which it is heard.
    open_to_it = dict.fromkeys(plan.assumes, torch.tensor([False]))
    plan = replace(plan, told=told, remembers=torch.tensor([False]), assumes=open_to_it)
    visible = experience(DRIVING, Course.of(DRIVING, two_cars_near(), STAY4), plan).rounds.visible
    assert visible["verbal"][0, :, 0].tolist() == [False, True, False, False, False]
    assert visible["visual"][0, :, 0].tolist() == [False, False, False, True, False]


def test_the_robot_drives_by_the_beliefs_that_it_learns_from(shipped, generator):
    model, _ = shipped
    start, plan = DRIVING.initial(300, generator), draw_views(DRIVING, 300, STEPS, generator)
    with torch.no_grad():
        actions = drive(model, start, plan, STEPS, generator)
        rounds = experience(DRIVING, Course.of(DRIVING, start, actions), plan).rounds
        belief = model.believe(model.evidence(rounds.observation, rounds.visible, actions))
        values = model.action_values(belief[:, :-1])
    chosen = values.gather(-1, actions[..., None]).squeeze(-1)
    assert (chosen >= values.amax(-1) - 1e-3).all()  # but for rounding
    assert 0.02 < actions.float().mean() < 0.98


def test_learning_looks_ahead_from_belief_to_belief(lived):
    """The value of the action that was taken is that of the belief that follows."""
    model, options = SelfModel(DRIVING), SelfModelOptions()
    asked = []

    def target(belief):
        asked.append(belief)
        return model.q_network(belief)

    rounds = lived.rounds
    loss = self_model_loss(model, target, lived, options, on_means=True)
    belief = model.believe(model.evidence(rounds.observation, rounds.visible, rounds.actions))
    taken = rounds.actions[..., None, None].expand(-1, -1, 1, model.latent)
    following = torch.stack(asked, 2).gather(2, taken).squeeze(2)
    # Where the world went on as they believed: what they see and assume is what they expected.
    same = torch.ones_like(rounds.actions, dtype=torch.bool)
    for name, visible in rounds.visible.items():
        expected, shown = (
            torch.stack(parts, 2)[torch.arange(40)[:, None], torch.arange(STEPS), rounds.actions]
            for parts in zip(
                *((one.observation[name], one.visible[name]) for one in lived.outcomes),
                strict=True,
            )
        )
        real, now = rounds.observation[name][:, 1:], visible[:, 1:]
        as_expected = (expected == real).all(-1)
        # On the road, what is where it was expected to be is in view if and only if expected so.
        on_road = real[..., 0].abs() < ROAD_END
        assert torch.equal(shown[as_expected & on_road], now[as_expected & on_road])
        same &= ((shown == now) & (as_expected | ~now)).all(-1)
    assert same.float().mean() > 0.5
    torch.testing.assert_close(following[same], belief[:, 1:][same], rtol=1e-4, atol=1e-5)
    # By hand: nothing follows the last action.
    values = model.q_network(torch.stack(asked, 2)).amax(-1)
    values[:, -1] = 0.0
    rewards = torch.stack([outcome.reward for outcome in lived.outcomes], -1)
    error = model.q_network(belief[:, :-1]) - (rewards + options.discount * values)
    torch.testing.assert_close(loss.bellman, error.square().mean(), rtol=1e-4, atol=1e-5)


def test_what_is_kept_of_rounds_is_what_is_computed():
    """A window of a whole round is the round; with values, no outcomes are computed."""
    start, actions = two_cars_near(), STAY4
    plan = fixed_views(DRIVING, 1, torch.Generator(), speech=True)
    course = Course.of(DRIVING, start, actions)
    found = experience(DRIVING, course.window(torch.tensor([0]), 0, 4), plan)
    expected = experience(DRIVING, course, plan)
    for name, value in expected.rounds.observation.items():
        assert torch.equal(found.rounds.observation[name], value)
    assert torch.equal(found.rounds.rewards, expected.rounds.rewards)
    assert torch.equal(found.outcomes[1].reward, expected.outcomes[1].reward)
    joined = Course.join([replace(course, values=torch.full((1, 4, 2), 7.0 + n)) for n in (0, 1)])
    second = joined.window(torch.tensor([1]), 0, 4)
    valued = experience(DRIVING, second, plan, stride=2)
    assert not valued.outcomes and torch.equal(valued.exact, torch.full((1, 2, 2), 8.0))
    part = joined.window(torch.tensor([1, 0]), 1, 2)
    assert torch.equal(part.values[:, 0, 0], torch.tensor([8.0, 7.0]))
    assert torch.equal(part.states.position[1], course.states.position[0, 1:4])
    assert torch.equal(part.observation["visual"][0], course.observation["visual"][0, 1:4])
    assert torch.equal(part.rewards[0], course.rewards[0, 1:3])


def test_nothing_is_decided_after_the_end():
    domain = get_domain("search_rescue")
    self_model, generator = SelfModel(domain), torch.Generator().manual_seed(0)
    start = domain.initial(8, generator)
    done = torch.arange(8) >= 4
    start = replace(start, found=start.found | done, home=start.home | done)
    actions = torch.randint(4, (8, 5), generator=generator)
    plan = fixed_views(domain, 8, generator, speech=True)
    exact = exact_values(domain, start, actions, plan, 0.9)
    assert (exact[done] == 0).all()
    agree, clear = _agreement(self_model, exact, start, actions, plan)
    best = robot_values(self_model, start, actions, plan)[~done].argmax(-1, keepdim=True)
    own = exact[~done]
    right = (own.gather(-1, best)[..., 0] >= own.amax(-1) - TIE).float()
    assert agree == pytest.approx(float(right.mean())) and agree < 0.9
    at_stake = own.amax(-1) - own.amin(-1) > 0.2
    assert clear == pytest.approx(float(right[at_stake].mean()))

"""The self-model: its bound, its experience, its training, and the weights that ship."""

import json
import math
import re
from dataclasses import replace

import pytest
import torch
from pyro import poutine
from pyro.infer import Trace_ELBO
from safetensors.torch import save_file
from torch.distributions import Normal

from mirror_ppl.domains import get_domain
from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.driving import ROAD_END, Driving, DrivingState
from mirror_ppl.errors import AssetError, CheckpointError
from mirror_ppl.evaluation.self_model import (
    fixed_views,
    planner_actions,
    returns,
    self_model_quality,
)
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import Sizes
from mirror_ppl.models.weights import load_self_model, save_self_model, shipped_weights
from mirror_ppl.training import self_model as self_model_training
from mirror_ppl.training.experience import Course, drive, experience
from mirror_ppl.training.self_model import (
    SelfModelOptions,
    self_model_loss,
    train_self_model,
)
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
    return experience(DRIVING, start, actions, draw_views(DRIVING, 40, STEPS, generator))


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


def two_cars_near():
    """The ego in the left lane; a slow car 3 cells ahead of it, and one 2 cells behind at right."""
    return DrivingState(
        lane=torch.tensor([0]),
        position=torch.tensor([[3, 11, -11, -2]]),
        speed=torch.tensor([[-1, 1, -1, -1]]),
    )


STAY4 = torch.zeros(1, 4, dtype=torch.long)


def test_outcomes_of_both_actions_in_full_view():
    plan = fixed_views(DRIVING, 1, torch.Generator(), speech=True)
    lived = experience(DRIVING, two_cars_near(), STAY4, plan)
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
    lived = experience(DRIVING, two_cars_near(), STAY4, plan)
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
    rounds = experience(DRIVING, two_cars_near(), STAY4, replace(plan, told=told)).rounds
    assert rounds.observation["visual"][0, :, 0, 0].tolist() == [ROAD_END, 2, 1, 0, -1]
    assert rounds.observation["verbal"][0, :, 0, 2].tolist() == [0, -1, -1, -1, -1]
    # Before, it was taken to be absent, of which there is no word.
    assert rounds.visible["verbal"][0, :, 0].tolist() == [False, True, True, True, True]
    assert rounds.visible["visual"].all()
    # To a person who does not remember, speech is only of the step at which it is heard.
    open_to_it = dict.fromkeys(plan.assumes, torch.tensor([False]))
    plan = replace(plan, told=told, remembers=torch.tensor([False]), assumes=open_to_it)
    visible = experience(DRIVING, two_cars_near(), STAY4, plan).rounds.visible
    assert visible["verbal"][0, :, 0].tolist() == [False, True, False, False, False]
    assert visible["visual"][0, :, 0].tolist() == [False, False, False, True, False]


def test_the_robot_drives_by_the_beliefs_that_it_learns_from(shipped, generator):
    model, _ = shipped
    start, plan = DRIVING.initial(300, generator), draw_views(DRIVING, 300, STEPS, generator)
    with torch.no_grad():
        actions = drive(model, start, plan, STEPS, generator)
        rounds = experience(DRIVING, start, actions, plan).rounds
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
    found = experience(DRIVING, start, actions, plan, course=course.window(torch.tensor([0]), 0, 4))
    expected = experience(DRIVING, start, actions, plan)
    for name, value in expected.rounds.observation.items():
        assert torch.equal(found.rounds.observation[name], value)
    assert torch.equal(found.rounds.rewards, expected.rounds.rewards)
    assert torch.equal(found.outcomes[1].reward, expected.outcomes[1].reward)
    joined = Course.join([replace(course, values=torch.full((1, 4, 2), 7.0 + n)) for n in (0, 1)])
    second = joined.window(torch.tensor([1]), 0, 4)
    valued = experience(DRIVING, start, actions, plan, stride=2, course=second)
    assert not valued.outcomes and torch.equal(valued.exact, torch.full((1, 2, 2), 8.0))
    part = joined.window(torch.tensor([1, 0]), 1, 2)
    assert torch.equal(part.values[:, 0, 0], torch.tensor([8.0, 7.0]))
    assert torch.equal(part.states.position[1], course.states.position[0, 1:4])
    assert torch.equal(part.observation["visual"][0], course.observation["visual"][0, 1:4])
    assert torch.equal(part.rewards[0], course.rewards[0, 1:3])


# --- training ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window": -1}, "must not be negative"),
        ({"distil": True}, "distil needs a window"),
        ({"distil": True, "window": 3, "exact": True}, "distil and exact are two ways"),
        ({"distil": True, "window": 5, "length": 4}, "window is 5, longer than rounds of 4 steps"),
    ],
)
def test_windows_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        train_self_model(DRIVING, SelfModelOptions(**options), torch.Generator())


def test_assumptions_that_a_world_does_not_work_out_are_not_trained_with():
    with pytest.raises(ValueError, match=r"assumed must be 0, as highway has no supposed\(\)"):
        options = SelfModelOptions.of("highway", assumed=0.5)
        train_self_model(get_domain("highway"), options, torch.Generator())


def test_a_planner_s_values_are_learned():
    options = SelfModelOptions(
        phases=1, rounds=64, steps=150, batch=16, learning_rate=3e-3, window=3, distil=True
    )
    domain = ShortDriving()
    robot = train_self_model(domain, options, torch.Generator().manual_seed(0))
    rounds = experience(
        domain,
        two_cars_near(),
        STAY4[:, :3],
        fixed_views(domain, 1, torch.Generator(), speech=True),
    ).rounds
    with torch.no_grad():
        evidence = robot.evidence(rounds.observation, rounds.visible, rounds.actions)
        found = robot.action_values(robot.believe(evidence[:, :1])[:, 0])
    exact = domain.reference_values(two_cars_near(), 0.9)
    assert (found - exact).abs().max() < 0.5 < (exact[0, 0] - exact[0, 1]).abs()


class ShortDriving(Driving):
    """Rounds of three steps that all begin alike."""

    horizon = 3

    def initial(self, batch, generator, scenario=None):
        return map_state(lambda part: part.expand(batch, *part.shape[1:]), two_cars_near())


def optimal_values(state, steps, discount=0.9):
    """Values of both actions with that many steps to go, by trying everything."""
    if steps == 0:
        return [0.0]
    values = []
    for action in (torch.tensor([0]), torch.tensor([1])):
        following = DRIVING.transition(state, action)
        reward = sum(DRIVING.rewards(state, action, following).values()).item()
        values.append(reward + discount * max(optimal_values(following, steps - 1)))
    return values


def test_values_move_to_the_optimum():
    domain = ShortDriving()
    best = torch.tensor([optimal_values(two_cars_near(), 3)])
    # Stay: -2 and switch next, -1, then the other lane for nothing. Switch: -1 and stay there.
    assert best.tolist() == [pytest.approx([-2.0 - 0.9, -1.0])]
    options = SelfModelOptions(
        phases=1, rounds=64, steps=150, batch=16, learning_rate=3e-3, target_rate=0.1, beta=0.0
    )

    def error(model):
        plan = fixed_views(domain, 1, torch.Generator(), speech=True)
        rounds = experience(domain, two_cars_near(), STAY4[:, :3], plan).rounds
        evidence = model.evidence(rounds.observation, rounds.visible, rounds.actions)
        with torch.no_grad():
            values = model.action_values(model.believe(evidence[:, :1])[:, 0])
        return (values - best).abs().max().item()

    before = error(SelfModel(domain))
    after = error(train_self_model(domain, options, torch.Generator().manual_seed(1)))
    assert before > 2.0
    # With errors of less than half of what is at stake, 1.9, the better action is chosen.
    assert after < 0.95


TINY = SelfModelOptions(phases=3, rounds=32, steps=2, batch=8)


def train(seed=0, options=TINY, report=lambda done, message: None, checkpoint=None):
    generator = torch.Generator().manual_seed(seed)
    return train_self_model(DRIVING, options, generator, report, checkpoint).state_dict()


def test_another_class_of_self_model_can_be_trained():
    class Other(SelfModel):
        pass

    trained = train_self_model(DRIVING, TINY, torch.Generator().manual_seed(0), kind=Other)
    assert type(trained) is Other
    assert_same(trained.state_dict(), train())


def test_rounds_are_seen_as_the_options_say(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    plan = draw_views(DRIVING, 50, 3, generator, (1.0, 0.0, 0.0))
    assert all((keep == 1).all() for keep in plan.keep.values())
    assert not plan.remembers.any()
    asked = []

    def noted(domain, batch, steps, generator, kinds, assumed):
        asked.append((batch, kinds))
        return draw_views(domain, batch, steps, generator, kinds, assumed)

    monkeypatch.setattr(self_model_training, "draw_views", noted)
    train(options=replace(TINY, kinds=(0.5, 0.5, 0.0)))
    # Those that are driven and those that are learned from.
    assert {*asked} == {(TINY.rounds, (0.5, 0.5, 0.0)), (TINY.batch, (0.5, 0.5, 0.0))}


def stop_after(phase):
    def report(done, message):
        if done == phase:
            raise KeyboardInterrupt

    return report


def assert_same(one, other):
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_training_depends_on_the_seed_alone():
    torch.manual_seed(1)
    one = train()
    torch.manual_seed(2)
    before = torch.random.get_rng_state()
    assert_same(one, train())
    assert torch.equal(torch.random.get_rng_state(), before)
    assert not torch.equal(train(seed=1)["reward.head.linear.bias"], one["reward.head.linear.bias"])


def test_training_goes_on_from_its_checkpoint_as_if_never_stopped(tmp_path):
    path, phases = tmp_path / "run.checkpoint", []
    with pytest.raises(KeyboardInterrupt):
        train(report=stop_after(2), checkpoint=path)
    resumed = train(report=lambda done, message: phases.append(done), checkpoint=path)
    assert phases == [3]
    assert_same(resumed, train())


def test_checkpoint_of_another_run_is_refused(tmp_path):
    path = tmp_path / "run.checkpoint"
    with pytest.raises(KeyboardInterrupt):
        train(report=stop_after(1), checkpoint=path)
    content = path.read_bytes()
    with pytest.raises(CheckpointError, match="other options"):
        train(options=replace(TINY, batch=9), checkpoint=path)
    with pytest.raises(CheckpointError, match="other options"):
        train(seed=1, checkpoint=path)
    assert path.read_bytes() == content
    for damaged in (content[: len(content) // 2], b"", b"nonsense"):
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=re.escape(str(path))):
            train(checkpoint=path)
    torch.save([1, 2], path)
    with pytest.raises(CheckpointError, match=re.escape(str(path))):
        train(checkpoint=path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("phases", 0, "phases must be at least 1, not 0"),
        ("batch", -1, "batch must be at least 1, not -1"),
        ("epsilon", 1.5, r"epsilon must lie in \[0, 1\], not 1.5"),
        ("discount", -0.1, r"discount must lie in \[0, 1\], not -0.1"),
        ("kinds", (1.0, -0.1, 0.1), r"kinds must be 3 numbers, .* not \(1.0, -0.1, 0.1\)"),
        ("kinds", (0.0, 0.0, 0.0), "not negative and not all 0"),
        ("kinds", (0.2, 0.2, 0.2, 0.4), "kinds must be 3 numbers"),
    ],
)
def test_impossible_options_are_refused(name, value, message):
    with pytest.raises(ValueError, match=message):
        SelfModelOptions(**{name: value})


# --- weights ----------------------------------------------------------------------------------


CARD = {"command": "test", "quality": {"share": 0.98}}


def test_weights_survive_a_round_trip(tmp_path):
    path, model = tmp_path / "a.safetensors", SelfModel(DRIVING)
    save_self_model(model, path, CARD)
    state = torch.random.get_rng_state()
    loaded, card = load_self_model(path, "driving")
    assert torch.equal(torch.random.get_rng_state(), state)
    assert_same(loaded.state_dict(), model.state_dict())
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

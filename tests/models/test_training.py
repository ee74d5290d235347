"""Training of self-models: what is learned, that runs resume, and what is refused."""

import math
import re
from dataclasses import replace

import pytest
import torch
from example_experience import STAY4, two_cars_near

from mirror_ppl.domains import get_domain
from mirror_ppl.domains.base import map_state, tensors_of
from mirror_ppl.domains.bomb_defusal.panel import OLD_RULES, RULES
from mirror_ppl.domains.bomb_defusal.world import BombDefusal
from mirror_ppl.domains.driving import Driving
from mirror_ppl.domains.highway import Highway
from mirror_ppl.domains.world import World
from mirror_ppl.errors import CheckpointError, InputError
from mirror_ppl.evaluation.self_model import fixed_views
from mirror_ppl.models.networks import BinnedQNetwork
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import sizes_of
from mirror_ppl.models.speech import EMBEDDINGS
from mirror_ppl.training import self_model as self_model_training
from mirror_ppl.training.experience import Course, experience
from mirror_ppl.training.self_model import _Trainer, train_self_model
from mirror_ppl.training.self_model_loss import self_model_loss
from mirror_ppl.training.self_model_options import SelfModelOptions
from mirror_ppl.training.views import draw_views

DRIVING = get_domain("driving")
STEPS = DRIVING.horizon


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window": -1}, "must not be negative"),
        ({"distil": True}, "distil needs a window"),
        ({"distil": True, "window": 3, "exact": True}, "distil and exact are two ways"),
        ({"choice_weight": 1.0}, "choice_weight needs distil"),
        ({"regret_weight": 1.0}, "regret_weight needs distil"),
        ({"regret_weight": -1.0}, "regret_weight must be at least 0"),
        ({"regret_margin": -1.0}, "regret_margin must be at least 0"),
        ({"distil": True, "window": 5, "length": 4}, "window is 5, longer than rounds of 4 steps"),
    ],
)
def test_windows_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        train_self_model(DRIVING, SelfModelOptions(**options), torch.Generator())


def test_assumptions_that_a_world_does_not_work_out_are_not_trained_with(monkeypatch):
    monkeypatch.setattr(Highway, "supposed", World.supposed)
    with pytest.raises(ValueError, match=r"assumed must be 0, as highway has no supposed\(\)"):
        options = SelfModelOptions.of("highway", assumed=0.5)
        train_self_model(get_domain("highway"), options, torch.Generator())


def test_a_planner_s_values_are_learned():
    options = SelfModelOptions(
        phases=1,
        rounds=64,
        steps=60,
        batch=16,
        learning_rate=5e-3,
        window=3,
        distil=True,
        assumed=0.0,
    )
    domain = ShortDriving()
    robot = train_self_model(domain, options, torch.Generator().manual_seed(0))
    rounds = experience(
        domain,
        Course.of(domain, two_cars_near(), STAY4[:, :3]),
        fixed_views(domain, 1, torch.Generator(), speech=True),
    ).rounds
    with torch.no_grad():
        evidence = robot.evidence(rounds.observation, rounds.visible, rounds.actions)
        found = robot.action_values(robot.believe(evidence[:, :1])[:, 0])
    exact = domain.reference_values(two_cars_near(), 0.9)
    assert (found - exact).abs().max() < 0.5 < (exact[0, 0] - exact[0, 1]).abs()


def test_values_between_strides_are_not_computed():
    domain = ShortDriving()
    options = SelfModelOptions(rounds=2, window=3, distil=True, stride=2, discount=0.9, assumed=0.0)
    trainer = _Trainer(
        domain, options, torch.Generator().manual_seed(0), 0, "words", sizes_of(domain), SelfModel
    )
    for _ in range(2):
        trainer._drive()
    first, second = trainer._course().values.split(2)
    assert first.isnan().any(-1).tolist() == [[False, True, False]] * 2
    assert second.isnan().any(-1).tolist() == [[True, False, True]] * 2
    exact = domain.reference_values(two_cars_near(), 0.9)
    torch.testing.assert_close(first[:, 0], exact.expand(2, -1))
    plan = fixed_views(domain, 4, torch.Generator(), speech=True)
    lived = experience(domain, trainer._course(), plan)
    assert torch.equal(lived.over, lived.exact.isnan().any(-1))


def three_moments():
    """A round in which everything is seen, with exact values."""
    return experience(
        DRIVING,
        Course.of(DRIVING, two_cars_near(), STAY4[:, :3]),
        fixed_views(DRIVING, 1, torch.Generator(), speech=True),
        discount=0.9,
    )


def test_choices_are_learned_where_all_that_counts_is_known():
    """Cross entropy and regret, by hand, of those of three moments that are known and go on."""
    robot = SelfModel(DRIVING, sizes_of(DRIVING), EMBEDDINGS["words"])
    options = SelfModelOptions(distil=True, window=3, world_weight=0.0)
    lived = three_moments()
    lived = replace(lived, informed=torch.tensor([[True, False, True]]))
    lived = replace(lived, over=torch.tensor([[False, False, True]]))
    with torch.no_grad():
        torch.manual_seed(0)
        without = self_model_loss(robot, robot.q_network, lived, options, True).total
        torch.manual_seed(0)
        found = self_model_loss(
            robot, robot.q_network, lived, replace(options, choice_weight=7.0), True
        ).total
        torch.manual_seed(0)
        regretted = self_model_loss(
            robot, robot.q_network, lived, replace(options, regret_weight=3.0), True
        ).total
        torch.manual_seed(0)
        beyond = replace(options, regret_weight=3.0, regret_margin=0.5)
        far = self_model_loss(robot, robot.q_network, lived, beyond, True).total
        evidence = robot.evidence(
            lived.rounds.observation, lived.rounds.visible, lived.rounds.actions
        )
        values = robot.action_values(robot.believe(evidence[:, :1])[0, 0])
    wanted = torch.softmax(lived.exact[0, 0], -1)
    entropy = -(wanted * torch.log_softmax(values, -1)).sum()
    torch.testing.assert_close(found - without, 7 * entropy)
    behind = lived.exact[0, 0].max() - lived.exact[0, 0]
    torch.testing.assert_close(regretted - without, 3 * torch.softmax(values, -1) @ behind)
    assert 0 < (behind - 0.5).clamp(min=0).max() < behind.max()
    counted = (behind - 0.5).clamp(min=0)
    torch.testing.assert_close(far - without, 3 * torch.softmax(values, -1) @ counted)


def test_bins_of_values_are_learned_by_cross_entropy():
    """By hand, of two moments that go on, in place of squared errors; and it can be learned."""
    sizes = replace(sizes_of(DRIVING), value_bins=41, least_value=-20, most_value=20)
    torch.manual_seed(0)
    robot = SelfModel(DRIVING, sizes, EMBEDDINGS["words"])
    network = robot.q_network
    options = SelfModelOptions(
        distil=True,
        window=3,
        world_weight=0.0,
        bin_weight=3.0,
        ranked_weight=0.5,
        difference_weight=5.0,
    )
    lived = three_moments()
    lived = replace(lived, over=torch.tensor([[False, False, True]]))

    def loss():
        torch.manual_seed(0)
        return self_model_loss(robot, network, lived, options, True)

    with torch.no_grad():
        rounds, goal = lived.rounds, lived.exact[0, :2]
        evidence = robot.evidence(rounds.observation, rounds.visible, rounds.actions)
        belief = robot.believe(evidence[:, :2])[0]
        found = loss()
        bins, learned = network.target(goal), network.log_probabilities(belief)
        wanted = -3 * (bins * learned).sum(-1).mean()
        wanted = wanted + 0.5 * network.ranked_cross_entropy(bins, learned).mean()
        torch.testing.assert_close(found.total, wanted)
        # Squared errors of the means are what is reported.
        torch.testing.assert_close(found.bellman, (network(belief) - goal).square().mean())
    optimizer = torch.optim.Adam(robot.parameters(), 3e-3)
    for _ in range(60):
        optimizer.zero_grad()
        loss().total.backward()
        optimizer.step()
    # Bins of width 1 give values within .1.
    assert loss().bellman < 0.1**2 < found.bellman


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
        rounds = experience(domain, Course.of(domain, two_cars_near(), STAY4[:, :3]), plan).rounds
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


BINS = replace(sizes_of(DRIVING), value_bins=9, least_value=-8.0, most_value=8.0)


def test_bins_of_values_are_trained_on_bootstrapped_values():
    trained = train_self_model(DRIVING, TINY, torch.Generator().manual_seed(0), sizes=BINS)
    first = train_self_model(
        DRIVING, replace(TINY, learning_rate=1e-9), torch.Generator().manual_seed(0), sizes=BINS
    )
    assert isinstance(trained.q_network, BinnedQNetwork)
    for part in (trained.q_network.value.weight, trained.encoder.ego.weight):
        assert torch.isfinite(part).all()
    assert not torch.allclose(
        trained.q_network.value.weight, first.q_network.value.weight, atol=1e-5
    )


def test_bins_cannot_be_learned_of_values_from_elsewhere():
    class Other(SelfModel):
        def action_values(self, belief):
            return -super().action_values(belief)

    with pytest.raises(InputError, match="value_bins must be 0, as Other has an action_values of"):
        train_self_model(DRIVING, TINY, torch.Generator(), sizes=BINS, kind=Other)


def test_ranked_cross_entropy_needs_bins():
    options = replace(TINY, ranked_weight=1.0)
    with pytest.raises(InputError, match="ranked_weight must be 0, as driving's"):
        train_self_model(DRIVING, options, torch.Generator())


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


KEPT = replace(TINY, window=4, stride=2, distil=True, choice_weight=1.0, assumed=0.5)
"""What happened is kept, for some rounds as it was believed."""


@pytest.mark.parametrize("options", [TINY, KEPT], ids=["computed", "kept"])
def test_training_goes_on_from_its_checkpoint_as_if_never_stopped(options, tmp_path):
    path, phases = tmp_path / "run.checkpoint", []
    with pytest.raises(KeyboardInterrupt):
        train(options=options, report=stop_after(2), checkpoint=path)

    def report(done, message):
        phases.append(done)

    resumed = train(options=options, report=report, checkpoint=path)
    assert phases == [3]
    assert_same(resumed, train(options=options))


def trainer(domain=DRIVING, kind=SelfModel):
    generator = torch.Generator().manual_seed(0)
    return _Trainer(domain, TINY, generator, 0, "words", sizes_of(domain), kind)


@pytest.mark.parametrize("large", [0, 2**40, -(2**40)])
def test_states_are_kept_exactly(large, tmp_path):
    one, other = trainer(), trainer()
    start = DRIVING.initial(4, torch.Generator().manual_seed(0))
    one.starts = [replace(start, position=start.position + large)]
    one._save(tmp_path / "a")
    other._restore(tmp_path / "a")
    for kept, part in zip(tensors_of(other.starts[0]), tensors_of(one.starts[0]), strict=True):
        assert kept.dtype == part.dtype and torch.equal(kept, part)


def test_checkpoint_of_another_world_or_class_is_refused(tmp_path):
    def mine(factor):
        """A class as a notebook defines it, without a file."""
        names = {"__name__": "notebook", "SelfModel": SelfModel}
        exec(
            "class Mine(SelfModel):\n"
            "    def action_values(self, belief):\n"
            f"        return {factor} * SelfModel.action_values(self, belief)\n",
            names,
        )
        return names["Mine"]

    bomb = BombDefusal(OLD_RULES), BombDefusal(RULES)
    pairs = [map(trainer, bomb), (trainer(kind=mine(factor)) for factor in (1, 100))]
    for number, (one, another) in enumerate(pairs):
        one._save(tmp_path / str(number))
        one._restore(tmp_path / str(number))
        with pytest.raises(CheckpointError, match="belongs to a run with other options"):
            another._restore(tmp_path / str(number))


def test_some_rounds_are_kept_as_they_were_believed():
    """With values of the believed world."""
    generator = torch.Generator().manual_seed(0)
    trainer = _Trainer(DRIVING, KEPT, generator, 0, "words", sizes_of(DRIVING), SelfModel)
    trainer._drive()
    kept = trainer._course()
    believed = kept.believed
    assert 0 < believed.sum() < TINY.rounds
    true = Course.of(DRIVING, trainer.starts[0], trainer.actions[0])
    changed = (kept.observation["visual"] != true.observation["visual"]).flatten(1).any(1)
    assert changed.any() and not (changed & ~believed).any()
    now = map_state(lambda part: part[:, :-1:2], kept.states)
    exact = DRIVING.reference_values(now, KEPT.discount)
    torch.testing.assert_close(kept.values[:, ::2], exact)


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
        ("ranked_weight", -1.0, "ranked_weight must be at least 0 and finite, not -1.0"),
        ("world_weight", -1.0, "world_weight must be at least 0 and finite, not -1.0"),
        ("speech_weight", -3.0, "speech_weight must be at least 0 and finite, not -3.0"),
        ("target_rate", 0.0, "target_rate must be above 0 and at most 1, not 0.0"),
        ("target_rate", 7, "target_rate must be above 0 and at most 1, not 7"),
        ("bin_weight", math.nan, "bin_weight must be at least 0 and finite, not nan"),
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

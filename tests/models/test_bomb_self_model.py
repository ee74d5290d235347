"""Self-models of bomb defusal: what is practised, by whose rules, and how good one is."""

from dataclasses import replace

import pytest
import torch

from mirror_ppl.commands.train import Options, main
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.bomb_defusal import BombDefusal
from mirror_ppl.evaluation.self_model import fixed_views, self_model_quality
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import sizes_of
from mirror_ppl.models.weights import load_self_model
from mirror_ppl.training.experience import Course, experience
from mirror_ppl.training.self_model import train_self_model
from mirror_ppl.training.self_model_loss import self_model_loss
from mirror_ppl.training.self_model_options import SelfModelOptions
from mirror_ppl.training.views import draw_views

WORLD = BombDefusal()


def test_terminals_are_noticed_at_the_rates_that_are_practised(generator):
    plan = draw_views(WORLD, 4000, 6, generator)
    rates = plan.keep["visual"]
    sight = plan.remembers
    assert ((rates[sight] >= 0.25) & (rates[sight] <= 1)).all()
    # Uniform: the mean of n numbers from .25 to 1 is within 4.5 * .75 / sqrt(12 n).
    assert abs(rates[sight].mean() - 0.625) < 4.5 * 0.75 / (12 * int(sight.sum())) ** 0.5
    assert (rates[~sight] == 1).any() and (rates[~sight] < 0.25).any()
    assert not plan.keep["verbal"][sight].any()
    # Of worlds in which what is near is seen at once, everything is kept.
    for name in ("driving", "search_rescue"):
        plan = draw_views(get_domain(name), 400, 6, generator)
        assert (plan.keep["visual"][plan.remembers] == 1).all()


def lived(generator, **plan):
    start = WORLD.anywhere(30, generator)
    actions = torch.randint(5, (30, 4), generator=generator)
    view = replace(fixed_views(WORLD, 30, generator, speech=True), **plan)
    return start, actions, experience(WORLD, Course.of(WORLD, start, actions), view, discount=0.9)


def test_who_knows_what_counts_has_exact_values_to_learn_from(generator):
    start, actions, full = lived(generator)
    assert full.informed.all()
    state = start
    for step in range(4):
        values = WORLD.reference_values(state, 0.9)
        torch.testing.assert_close(full.exact[:, step], values)
        state = WORLD.transition(state, actions[:, step])
    deaf = {"visual": torch.ones(30), "verbal": torch.zeros(30)}
    uninformed = lived(generator, keep=deaf)[2]
    assert torch.equal(uninformed.informed, uninformed.over)
    # The terminal that is lit is all that counts besides the type.
    some = {"visual": torch.full((30,), 0.5), "verbal": torch.ones(30)}
    part = lived(generator, keep=some, remembers=torch.zeros(30, dtype=torch.bool))[2]
    now = {name: value[:, :4] for name, value in part.rounds.observation.items()}
    seen = (part.rounds.visible["visual"][:, :4] & WORLD.sought(now)).any(-1)
    assert torch.equal(part.informed, seen | part.over)
    assert 0.2 < seen.float().mean() < 0.8
    # Where they are, they are what is learned.
    torch.manual_seed(0)
    self_model, options = SelfModel(WORLD), SelfModelOptions()

    def bellman(some):
        torch.manual_seed(1)
        return self_model_loss(
            self_model, self_model.q_network, some, options, on_means=True
        ).bellman

    far = replace(full, exact=full.exact + 100)
    assert bellman(far) > 9000
    nobody = replace(far, informed=torch.zeros_like(full.informed))
    none = replace(full, exact=None)
    torch.testing.assert_close(bellman(nobody), bellman(none))
    assert bellman(none) < 100


def test_errors_that_all_actions_share_count_once(generator):
    """The weight adds nothing if all errors are equal, 4 / 5 of the mean square if one errs."""
    _, _, full = lived(generator)
    torch.manual_seed(0)
    self_model = SelfModel(WORLD)
    values = self_model.action_values
    some = replace(full, informed=torch.ones_like(full.informed))

    def total(weight, off):
        torch.manual_seed(1)
        options = SelfModelOptions(world_weight=0.0, difference_weight=weight)
        self_model.action_values = lambda belief: (full.exact + off)[~some.over]
        try:
            return self_model_loss(
                self_model, self_model.q_network, some, options, on_means=True
            ).total.item()
        finally:
            self_model.action_values = values

    shared, alone = torch.full((5,), 2.0), torch.tensor([2.0, 0, 0, 0, 0])
    assert total(0.0, shared) == pytest.approx(4.0)
    assert total(3.0, shared) == pytest.approx(4.0)
    assert total(0.0, alone) == pytest.approx(4 / 5)
    assert total(3.0, alone) == pytest.approx(4 / 5 + 3 * 4 / 5 * (4 / 5))


def test_a_robot_is_taught_and_judged_by_the_rules_that_it_was_taught(tmp_path):
    """By hand: a self-model that presses what the old rules say."""

    class Taught(SelfModel):
        """Knows the state behind a belief, which is the bomb itself."""

        def action_values(self, belief):
            return belief[..., :5]

    torch.manual_seed(0)
    robot = Taught(WORLD)

    class Reads(torch.nn.Module):
        """An encoder whose belief is the old rules' values of what there is to see."""

        def __init__(self, encoder):
            super().__init__()
            self.action = encoder.action

        def evidence(self, symbols, visible):
            observation = {
                "ego": torch.nn.functional.pad(
                    symbols["ego"].argmax(-1, keepdim=True).float(), [0, 1]
                ),
                "visual": symbols["visual"],
                "verbal": symbols["verbal"].argmax(-1, keepdim=True).float(),
            }
            values = WORLD.as_believed.reference_values(WORLD.state_behind(observation), 0.9)
            return torch.nn.functional.pad(values, [0, 128 - 5])

        def previous_actions(self, actions):
            return torch.zeros(*actions.shape[:-1], actions.shape[-1] + 1, 128)

        def forward(self, previous, evidence):
            return type("Mean", (), {"mean": evidence[..., :48]})

    robot.encoder = Reads(robot.encoder)
    with torch.no_grad():
        robot.encoder.action.weight.zero_()
    quality = self_model_quality(robot, rounds=400, discount=0.9)
    assert quality["return_exact"] == quality["return_full"] == pytest.approx(12)
    assert quality["share_full"] == pytest.approx(1)
    assert quality["return_exact_as_it_is"] == pytest.approx(12)
    # Half of the symbols have another button now: half of three presses cost 10 more each.
    # The mean of 1,200 presses, each worth 5 or -5, is within 4.5 * 10 * .5 / sqrt(1200) a press.
    assert abs(quality["return_as_it_is"] - (12 - 15)) < 3 * 4.5 * 5 / 1200**0.5
    assert "share_clear" not in quality


def test_training_writes_a_self_model_of_the_world_as_it_is(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(BombDefusal, "record", replace(BombDefusal.record, measured=200))
    out = tmp_path / "bomb.safetensors"
    main(Options(domain="bomb_defusal", out=out, phases=1, steps=1))
    self_model, card = load_self_model(out, "bomb_defusal")
    assert self_model.domain.rules == WORLD.rules
    assert self_model.sizes == sizes_of(WORLD)
    assert {"share_full", "return_as_it_is"} <= set(card["quality"])
    assert "return as it is" in capsys.readouterr().out


def test_the_supplement_s_sizes_run():
    """Stride 2, 64 units between convolution and features, a Q-network of 3 x 2048."""
    sizes = sizes_of(WORLD, paper=True)
    assert (sizes.stride, sizes.image, sizes.q_network) == (2, 64, 2048)
    assert sizes_of(get_domain("driving"), paper=True) == sizes_of(get_domain("driving"))
    options = SelfModelOptions.of("bomb_defusal", phases=1, rounds=8, steps=1, batch=4, length=3)
    generator = torch.Generator().manual_seed(0)
    trained = train_self_model(WORLD.as_believed, options, generator, sizes=sizes)
    assert trained.q_network.latent.out_features == 2048
    assert torch.isfinite(trained.q_network.value.weight).all()

"""Self-models of bomb defusal: what is practised, by whose rules, and how good one is."""

import math
from dataclasses import replace

import pytest
import torch

from mirror_ppl.domains import get_domain
from mirror_ppl.domains.bomb_defusal import BombDefusal
from mirror_ppl.evaluation.self_model import fixed_views, self_model_quality
from mirror_ppl.inference.experience import experience
from mirror_ppl.inference.self_model_training import (
    SelfModelOptions,
    self_model_loss,
    train_self_model,
)
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import PAPER, SIZES
from mirror_ppl.models.views import draw_views
from mirror_ppl.models.weights import load_self_model
from mirror_ppl.train import Options, main

WORLD = BombDefusal()


def test_terminals_are_noticed_at_the_rates_that_are_practised(generator):
    plan = draw_views(WORLD, 4000, 6, generator)
    rates, sight = plan.keep["visual"], plan.remembers
    assert torch.equal(plan.searches, sight)
    assert ((rates[sight] >= 0.05) & (rates[sight] <= 1)).all()
    # Log-uniform: the mean of n logarithms is within 4.5 standard errors of the middle.
    logs = rates[sight].log()
    assert abs(logs.mean() - 0.5 * math.log(0.05)) < 4.5 * logs.std() / len(logs) ** 0.5
    assert (rates[~sight] == 1).any() and (rates[~sight] < 0.25).any()
    heard = plan.keep["verbal"][sight]
    assert set(heard.tolist()) == {0.0, 1.0}
    assert abs(heard.mean() - 0.5) < 4.5 * 0.5 / len(heard) ** 0.5
    # Of worlds in which what is near is seen at once, everything is kept.
    for name in ("driving", "search_rescue"):
        plan = draw_views(get_domain(name), 400, 6, generator)
        assert (plan.keep["visual"][plan.remembers] == 1).all() and not plan.searches.any()
        assert not plan.keep["verbal"][plan.remembers].any()


def test_in_easy_phases_nothing_is_overlooked_for_long(generator):
    plan = draw_views(WORLD, 4000, 6, generator, easy=True)
    sight = plan.remembers
    assert not plan.searches.any()
    assert ((plan.keep["visual"][sight] >= 0.25) & (plan.keep["visual"][sight] <= 1)).all()
    assert 0.4 < float(plan.told["visual"].max()) <= 0.5
    # Where nobody has to search it is the same as ever.
    plans = [
        draw_views(get_domain("driving"), 9, 3, torch.Generator().manual_seed(0), easy=easy)
        for easy in (False, True)
    ]
    assert torch.equal(plans[0].noise["visual"], plans[1].noise["visual"])
    assert torch.equal(plans[0].keep["visual"], plans[1].keep["visual"])


def test_who_searches_sees_only_what_counts_and_hopes_to_see_it_soon(generator):
    state = WORLD.initial(4000, generator)
    observation = {name: value[:, None] for name, value in WORLD.observe(state).items()}
    plan = draw_views(WORLD, 4000, 1, generator)
    slow = replace(
        plan,
        searches=torch.ones_like(plan.searches),
        keep={"visual": torch.full((4000,), 0.1), "verbal": torch.zeros(4000)},
    )
    lit = torch.arange(6) == state.live[:, :1]
    for own, rate in ((slow, 0.1), (slow.hoping(WORLD), 0.5)):
        seen = own.sees(WORLD, observation)
        assert not seen["verbal"].any()
        assert not seen["visual"][:, 0][~lit].any()
        found = seen["visual"][:, 0][lit].float()
        assert abs(found.mean() - rate) < 4.5 * (rate * (1 - rate) / 4000) ** 0.5
    # Who is quicker than that, or does not search, hopes for nothing else.
    quick = replace(slow, keep={**slow.keep, "visual": torch.full((4000,), 0.8)})
    assert (quick.hoping(WORLD).keep["visual"] == 0.8).all()
    idle = replace(slow, searches=torch.zeros_like(plan.searches))
    assert (idle.hoping(WORLD).keep["visual"] == 0.1).all()
    assert idle.sees(WORLD, observation)["visual"][:, 0][~lit].any()


def test_what_follows_is_seen_as_hoped_for(generator):
    """Nobody notices anything on the way, and everybody expects to: after the present step."""
    start = WORLD.initial(4000, generator)
    waits = torch.zeros(4000, 3, dtype=torch.long)
    plan = draw_views(WORLD, 4000, 3, generator)
    blind = replace(
        plan,
        searches=torch.ones_like(plan.searches),
        remembers=torch.ones_like(plan.searches),
        keep={"visual": torch.zeros(4000), "verbal": torch.zeros(4000)},
        told={name: torch.zeros(4000) for name in plan.told},
    )
    lived = experience(WORLD, start, waits, blind)
    assert not lived.rounds.visible["visual"].any()
    for outcome in lived.outcomes:
        found = outcome.visible["visual"].any(-1).float().mean(0)
        assert ((found - 0.5).abs() < 4.5 * 0.5 / 4000**0.5).all()


def lived(generator, **plan):
    start = WORLD.anywhere(30, generator)
    actions = torch.randint(5, (30, 4), generator=generator)
    view = replace(fixed_views(WORLD, 30, generator, speech=True), **plan)
    return start, actions, experience(WORLD, start, actions, view, discount=0.9)


def test_who_knows_everything_has_exact_values_to_learn_from(generator):
    start, actions, full = lived(generator)
    assert full.informed.all()
    state = start
    for step in range(4):
        values = WORLD.reference_values(state, 0.9)
        torch.testing.assert_close(full.exact[:, step], values)
        state = WORLD.transition(state, actions[:, step])
    deaf = {"visual": torch.ones(30), "verbal": torch.zeros(30)}
    assert not lived(generator, keep=deaf)[2].informed.any()
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

        def embed(self, symbols):
            observation = {
                "ego": torch.nn.functional.pad(
                    symbols["ego"].argmax(-1, keepdim=True).float(), [0, 1]
                ),
                "visual": symbols["visual"],
                "verbal": symbols["verbal"].argmax(-1, keepdim=True).float(),
            }
            values = WORLD.as_believed.reference_values(WORLD.state_behind(observation), 0.9)
            return {"ego": torch.nn.functional.pad(values, [0, 128 - 5])}

        def combine(self, embedded, visible, *others):
            return embedded["ego"]

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


def test_training_writes_a_self_model_of_the_world_as_it_is(tmp_path, capsys):
    out = tmp_path / "bomb.safetensors"
    main(Options(domain="bomb_defusal", out=out, phases=1, steps=1))
    self_model, card = load_self_model(out, "bomb_defusal")
    assert self_model.domain.rules == WORLD.rules
    assert self_model.sizes == SIZES["bomb_defusal"]
    assert {"share_full", "return_as_it_is"} <= set(card["quality"])
    assert "return as it is" in capsys.readouterr().out


def test_the_supplement_s_sizes_run():
    """Stride 2, 64 units between convolution and features, a Q-network of 3 x 2048."""
    sizes = PAPER["bomb_defusal"]
    assert (sizes.stride, sizes.image, sizes.q_network) == (2, 64, 2048)
    assert PAPER["driving"] == SIZES["driving"]
    options = SelfModelOptions.of("bomb_defusal", phases=1, rounds=8, steps=1, batch=4, length=3)
    generator = torch.Generator().manual_seed(0)
    trained = train_self_model(WORLD.as_believed, options, generator, sizes=sizes)
    assert trained.q_network.latent.out_features == 2048
    assert torch.isfinite(trained.q_network.value.weight).all()

"""Parts of the model of bomb defusal: what each leaves out, and what stays the same."""

import pytest
import torch
from example_bomb import WORLD, course, implants
from example_course import beliefs_of, gone_through, perceived

from mirror_ppl.domains import get_domain
from mirror_ppl.domains.bomb_defusal.human import RULE, BombDefusalHuman
from mirror_ppl.domains.bomb_defusal.panel import RULES
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import sample_sites
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.world_knowledge import planning_domain
from mirror_ppl.people import simulate

SEARCH = {
    "notice_mean",
    "notice_concentration",
    "reads_type",
    *(f"notices_terminal {k}" for k in range(1, 7)),
}
CHOICE = {"consistency", "lapse"}
RESIDUAL = {"residual_in", "residual_out"}
RULES_OF = {"rule_type_a", "rule_type_b"}


@pytest.fixture(scope="module")
def robot():
    torch.manual_seed(0)
    return SelfModel(WORLD)


def variant(name, robot):
    return load_human_model(name, robot)


@pytest.mark.parametrize(
    ("name", "sites", "attends"),
    [
        ("mirror", SEARCH | CHOICE | RESIDUAL | RULES_OF, True),
        ("perceptual-only", SEARCH | CHOICE, True),
        ("policy-only", CHOICE | RESIDUAL | RULES_OF, False),
        ("no-implants", CHOICE, False),
    ],
)
def test_the_sites_of_each(name, sites, attends, robot):
    human = variant(name, robot)
    check_contract(human)
    assert set(sample_sites(human, 1, 1)) == sites
    assert human.has_round_latents == attends


def test_perception_alone_is_mirror_with_the_robot_s_rules_and_no_residual(robot):
    mirror, part = variant("mirror", robot), variant("perceptual-only", robot)
    own = implants(mirror, consistency=4.0, lapse=0.1)
    own |= {name: torch.zeros_like(own[name]) for name in (*RULES_OF, *RESIDUAL)}
    sites = own | {f"found_{stage}": torch.tensor([[2 + stage]]) for stage in range(3)}
    sites |= {"guess": torch.tensor([[1]])}
    actions = torch.tensor([[0, 0, 0, 2, 0, 1, 3, 0]])
    observation, _ = course(actions[0, :-1].tolist())
    told = {"visual": torch.zeros(1, 8, 6).bool(), "verbal": torch.zeros(1, 8, 1).bool()}
    told["verbal"][0, 5] = True
    found = []
    for human in (mirror, part):
        seen = {name: sites[name][0] for name in sites}
        belief = gone_through(human, seen, observation, told, actions)
        chosen = {name: own[name] for name in own if human is mirror or name in SEARCH | CHOICE}
        found.append(human.act(chosen, belief, human.action_values(belief)))
    torch.testing.assert_close(*found)


def test_policy_alone_sees_all_at_once_and_presses_by_the_rules(robot):
    part, plain = variant("policy-only", robot), variant("no-implants", robot)
    observation, _ = course([0, 1, 2])
    told = {"visual": torch.zeros(1, 4, 6).bool(), "verbal": torch.zeros(1, 4, 1).bool()}
    for human in (part, plain):
        view = perceived(human, {}, observation, told)
        assert view.visible["visual"].all() and view.visible["verbal"].all() and not view.taken
    belief = beliefs_of(part, view, observation, torch.zeros(1, 4, dtype=torch.long))
    values = part.action_values(belief)
    own = {name: torch.zeros(1, 1) for name in RULES_OF}
    own |= {"consistency": torch.full((1, 1), 3.0), "lapse": torch.full((1, 1), 0.1)}
    torch.testing.assert_close(part.act(own, belief, values), plain.act(own, belief, values))
    # Under a rule of both types the same as the whole model.
    own |= {name: torch.full((1, 1), 7) for name in RULES_OF}
    whole = variant("mirror", robot)
    torch.testing.assert_close(part.act(own, belief, values), whole.act(own, belief, values))
    assert not torch.equal(part.act(own, belief, values), plain.act(own, belief, values))


def test_what_rewards_identify_of_the_world_needs_no_implant(robot):
    human = variant("perceptual-only", robot)
    assert isinstance(human, BombDefusalHuman) and type(human) is not BombDefusalHuman
    human.fit_world(simulate("bomb_defusal", "labelled", "paper", 3, rounds=20, seed=0))
    world = human.planning_domain({})
    assert world.rules == RULES  # pyright: ignore[reportAttributeAccessIssue]


def test_models_that_learn_nothing_of_the_world_plan_in_the_one_that_was_taught(robot):
    taught = robot.domain.as_believed
    assert taught.rules != RULES  # pyright: ignore[reportAttributeAccessIssue]
    for name in ("per-item", "no-implants"):
        world = planning_domain(variant(name, robot), {})
        assert world.rules == taught.rules  # pyright: ignore[reportAttributeAccessIssue]
    driver = variant("mirror", SelfModel(get_domain("driving")))
    assert planning_domain(driver, {}) is driver.domain


def test_draws_of_rules_go_before_what_was_learned(robot):
    """The planning domain has the rules of a draw, not the most probable ones."""
    human = variant("mirror", robot)
    other = torch.full((3, 1, 1), 5)
    drawn = human.planning_domain({RULE + kind: other for kind in human.kinds})
    assert drawn.rules != human.planning_domain({}).rules

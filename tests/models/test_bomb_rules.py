"""Rules of bomb defusal: people exchange buttons by them, and rewards tell them."""

from dataclasses import replace
from itertools import permutations

import pytest
import torch
from example_bomb import RESIDUAL, WORLD, implants

import mirror_ppl
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains.bomb_defusal.human import BombDefusalHuman
from mirror_ppl.domains.bomb_defusal.panel import BUTTONS, OLD_RULES, RULES
from mirror_ppl.inference.results.summary import summarize
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate

ORDERS = list(permutations(range(4)))


@pytest.fixture(scope="module")
def defuser():
    torch.manual_seed(0)
    return BombDefusalHuman(SelfModel(WORLD))


def test_buttons_are_exchanged_by_the_rule_of_the_type_believed_in(defuser, monkeypatch):
    """Where the robot would press b, they press ORDERS[rule][b]: values go with the buttons."""
    values = torch.tensor([0.5, 1.0, 2.0, 3.0, 4.0]).expand(1, 1, 5)
    belief = torch.zeros(1, 1, 48)
    for kind, rule in ((0, 1), (1, 9)):
        monkeypatch.setattr(
            defuser, "believed_kind", lambda belief, kind=kind: torch.full((1, 1), float(kind))
        )
        some = implants(defuser, lapse=1e-9, consistency=1.0) | {
            **{name: torch.zeros(1, 1, *shape) for name, shape in RESIDUAL.items()},
            "rule_type_a": torch.tensor([[1]]),
            "rule_type_b": torch.tensor([[9]]),
        }
        found = defuser.act(some, belief, values).flatten()
        expected = torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0])
        for robot in range(4):
            expected[1 + ORDERS[rule][robot]] = 1.0 + robot
        torch.testing.assert_close(found, expected.log_softmax(0), rtol=0, atol=1e-4)


def test_rules_are_learned_from_rewards_and_planned_with():
    """Rewards of 60 rounds identify the rules, with probability above .99 of each type."""
    torch.manual_seed(0)
    human = BombDefusalHuman(SelfModel(WORLD))
    torch.testing.assert_close(human.rule_logits.exp().sum(-1), torch.ones(2))
    assert human.rule_logits.exp()[:, 0].tolist() == pytest.approx([0.5, 0.5])
    recorded = simulate("bomb_defusal", "labelled", people=3, rounds=20, seed=1)
    human.fit_world(recorded)
    learned = [ORDERS[int(logits.argmax())] for logits in human.rule_logits]
    assert human.rule_logits.exp().amax(-1).min() > 0.99
    for kind in range(2):
        for symbol in range(4):
            assert learned[kind][OLD_RULES[kind][symbol]] == RULES[kind][symbol]
    some = implants(human)
    assert human.planning_domain({name: value[None] for name, value in some.items()}).rules == RULES
    # Asked again it learns the same.
    before = human.rule_logits.clone()
    human.fit_world(recorded)
    assert torch.equal(human.rule_logits, before)
    # Without rewards there is nothing to learn.
    human.fit_world(replace(recorded, rewards=None))
    assert human.rule_logits.exp()[:, 0].tolist() == pytest.approx([0.5, 0.5])


def test_a_fit_learns_rules_in_a_model_of_its_own():
    human = BombDefusalHuman(load_self_model(shipped_weights("bomb_defusal"), "bomb_defusal")[0])
    before = human.rule_logits.clone()
    recorded = simulate("bomb_defusal", "labelled", people=1, rounds=1, seed=1)
    few = {"settings": {"proposals": 64, "enough": 4.0}, "draws": 4, "explore": 0}
    fit = mirror_ppl.infer(recorded, human=human, engine="importance", train_rounds=1, **few)
    assert torch.equal(human.rule_logits, before)
    assert isinstance(fit.human, BombDefusalHuman)
    assert not torch.equal(fit.human.rule_logits, before)


def test_of_rules_the_most_probable_one_is_reported():
    human = BombDefusalHuman(load_self_model(shipped_weights("bomb_defusal"), "bomb_defusal")[0])
    names = human.value_names["rule_type_b"]
    assert len(names) == len(set(names)) == len(human.exchanges)
    # What is pressed for the robot's second button by the rule of that name.
    pressed = human.exchanges[9][:, 1].argmax()
    assert names[9].split()[1] == BUTTONS[pressed]
    assert names[0] == f"{' '.join(BUTTONS)} (as the robot)"
    recorded = load_demonstrations(asset_path("bomb_defusal_unlabelled_paper.nc"))
    train = recorded.select_people([0]).select_rounds([0])
    draws = {
        "rule_type_b": torch.tensor([[9], [9], [9], [2]]),
        "lapse": torch.tensor([[0.1], [0.2], [0.3], [0.4]]),
    }
    (person,) = summarize(draws, train, None, human.value_names)
    assert person["implants"]["rule_type_b"] == {
        "most_probable": names[9], "probability": 0.75, "truth": None
    }  # fmt: skip
    assert person["implants"]["lapse"]["median"] == pytest.approx(0.2)

"""The world of bomb defusal: pure functions, by hand and against an exact planner."""

import itertools
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from mirror_ppl.domains import Domain, get_domain
from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.bomb_defusal import BombDefusal, BombState
from mirror_ppl.domains.bomb_defusal.drawing import AHEAD, GAP, LAMP, MARGIN, OVER
from mirror_ppl.domains.bomb_defusal.panel import (
    BUTTONS,
    OLD_RULES,
    PICTURE,
    RULES,
    SYMBOLS,
    panel,
    pictures,
    read_panel,
)
from mirror_ppl.errors import UnknownNameError

WORLD: Domain = BombDefusal()
WAIT, RED, GREEN, BLUE, YELLOW = range(5)
TABLE = {
    ("A", "cross"): RED,
    ("A", "plus"): GREEN,
    ("A", "frame"): YELLOW,
    ("A", "bars"): BLUE,
    ("B", "cross"): YELLOW,
    ("B", "plus"): BLUE,
    ("B", "frame"): GREEN,
    ("B", "bars"): RED,
}
"""The right action, by type and symbol."""
TAUGHT = TABLE | {
    ("A", "frame"): BLUE,
    ("A", "bars"): YELLOW,
    ("B", "cross"): GREEN,
    ("B", "frame"): YELLOW,
}
"""The action that the robot was taught to be right, by type and symbol."""


def start(number=8, scenario=None, seed=0):
    return WORLD.initial(number, torch.Generator().manual_seed(seed), scenario)


def bomb(kind, *shown):
    """One bomb whose lit terminals are 0, 1 and 2, with these symbols; the others show bars."""
    symbols = torch.full((3, 6), list(SYMBOLS).index("bars"))
    for stage, symbol in enumerate(shown):
        symbols[stage, stage] = list(SYMBOLS).index(symbol)
    nothing = torch.tensor(0)
    return BombState(nothing, nothing, torch.tensor("AB".index(kind)), torch.arange(3), symbols)


def play(state, actions, world=WORLD):
    """States and rewards, term by term, along actions."""
    states, terms = [state], []
    for action in actions:
        chosen = torch.tensor(action)
        following = world.transition(states[-1], chosen)
        found = world.rewards(states[-1], chosen, following)
        terms.append({name: float(value) for name, value in found.items() if value})
        states.append(following)
    return states, terms


def test_a_defusal_by_hand():
    state = bomb("A", "cross", "bars", "plus")
    states, terms = play(state, [WAIT, WAIT, RED, BLUE, WAIT, RED, GREEN])
    time = {"time": -1.0}
    assert terms[:2] == [time, time]
    assert terms[2:4] == [{"right": 5.0} | time] * 2
    assert terms[4] == time
    assert terms[5] == {"wrong": -5.0} | time
    # It is over after the third press, and nothing counts any more.
    assert terms[6] == {}
    assert [int(each.stage) for each in states] == [0, 0, 0, 1, 2, 2, 3, 3]
    assert [int(each.since) for each in states] == [0, 1, 2, 0, 0, 1, 0, 0]
    assert [bool(WORLD.over(each)) for each in states] == [False] * 6 + [True] * 2
    assert sum(sum(step.values()) for step in terms) == 5 + 5 - 5 - 6


def test_which_button_is_right_is_what_the_rules_say():
    believed = WORLD.as_believed
    for (kind, symbol), button in TABLE.items():
        state = bomb(kind, symbol)
        for world, table in ((WORLD, TABLE), (believed, TAUGHT)):
            for action in range(1, 5):
                _, (terms,) = play(state, [action], world)
                right = action == table[kind, symbol]
                assert terms == {"right" if right else "wrong": 5.0 if right else -5.0, "time": -1}
            assert int(world.reference_values(state, 0.9).argmax()) == table[kind, symbol]
        del button


def test_old_rules_are_wrong_for_half_and_every_symbol_needs_the_type():
    wrong = [RULES[k][s] != OLD_RULES[k][s] for k in range(2) for s in range(4)]
    assert sum(wrong) == 4
    for rules in (RULES, OLD_RULES):
        assert all(sorted(row) == [0, 1, 2, 3] for row in rules)
        assert all(a != b for a, b in zip(*rules, strict=True))
    assert WORLD.as_believed.rules == OLD_RULES
    assert WORLD.as_believed.as_believed.rules == OLD_RULES
    for other in ("driving", "search_rescue"):
        assert get_domain(other).as_believed is get_domain(other)


def test_scenarios_are_the_types_and_the_rest_is_drawn():
    assert WORLD.scenarios == ("Type A bomb", "Type B bomb")
    assert start(scenario=torch.arange(8) % 2).kind.tolist() == [0, 1] * 4
    one, other = start(seed=3), start(seed=3)
    for part in fields(one):
        assert torch.equal(getattr(one, part.name), getattr(other, part.name))
    drawn = start(6000)
    counts = torch.bincount(drawn.live[:, 1], minlength=6)
    assert ((counts - 1000).abs() < 5 * 1000**0.5).all()
    counts = torch.bincount(drawn.symbols[:, 2, 4], minlength=4)
    assert ((counts - 1500).abs() < 5 * 1500**0.5).all()
    anywhere = WORLD.anywhere(600, torch.Generator().manual_seed(0))
    assert set(anywhere.stage.tolist()) == {0, 1, 2}


def test_one_round_in_a_batch_is_that_round_alone(generator):
    state = WORLD.initial(6, generator)
    single = [map_state(lambda part, k=k: part[k], state) for k in range(6)]
    for action in torch.randint(5, (8, 6), generator=generator):
        following = WORLD.transition(state, action)
        rewards = WORLD.rewards(state, action, following)
        observed = WORLD.observe(following)
        for k in range(6):
            after = WORLD.transition(single[k], action[k])
            own = WORLD.rewards(single[k], action[k], after)
            assert all(float(own[n]) == float(v[k]) for n, v in rewards.items())
            for name, value in WORLD.observe(after).items():
                assert torch.equal(value, observed[name][k])
            single[k] = after
        state = following


def test_exact_values_are_those_of_every_course():
    """By trying everything that can be done in four steps, of which the last only lead to ends."""
    state = bomb("B", "cross", "frame", "bars")

    def best(state, left):
        if not left or bool(WORLD.over(state)):
            return 0.0
        return max(value(state, action, left) for action in range(5))

    def value(state, action, left):
        chosen = torch.tensor(action)
        following = WORLD.transition(state, chosen)
        terms = WORLD.rewards(state, chosen, following)
        return float(sum(terms.values())) + 0.9 * best(following, left - 1)

    for presses in ([], [YELLOW], [YELLOW, RED]):
        now = play(state, presses)[0][-1]
        exact = WORLD.reference_values(now, 0.9)
        assert exact.tolist() == pytest.approx([value(now, a, 4) for a in range(5)], abs=1e-5)
    over = play(state, [RED] * 3)[0][-1]
    assert WORLD.reference_values(over, 0.9).tolist() == [0.0] * 5


def test_terminals_show_symbols_and_one_is_lit():
    observation = WORLD.observe(bomb("A", "cross", "plus"))
    pixels = observation["visual"].unflatten(-1, PICTURE)
    lit, dim = pixels[0], pixels[3]
    drawn = torch.tensor([[c == "#" for c in row] for row in SYMBOLS["cross"]])
    assert torch.equal(lit[..., 1] > 0.9, drawn)
    bars = torch.tensor([[c == "#" for c in row] for row in SYMBOLS["bars"]])
    assert torch.equal(dim[..., 0] > 0.3, bars) and float(dim.max()) < 0.4
    everything = pictures().flatten(0, 1)
    apart = (everything[:, None] - everything).abs().amax(-1)
    assert (apart[~torch.eye(8, dtype=torch.bool)] > 0.2).all()
    # When all is done nothing is lit.
    over = WORLD.observe(play(bomb("A", "cross"), [RED] * 3)[0][-1])
    assert float(over["visual"].max()) < 0.4
    picture = WORLD.render(bomb("A", "cross"))
    assert picture.dtype == np.uint8 and picture.ndim == 3
    assert (picture == (51, 255, 102)).all(-1).any()


def test_lamps_do_not_say_that_a_press_was_right():
    """A state holds how many stages are over, so its picture is the same after any press."""
    begun = bomb("A", "cross")
    right, wrong = (WORLD.render(play(begun, [press])[0][-1]) for press in (RED, GREEN))
    assert np.array_equal(right, wrong)
    lamps = right[-8, [GAP + number * (LAMP + MARGIN) for number in range(3)]].tolist()
    assert lamps == [list(OVER), list(AHEAD), list(AHEAD)]
    assert len(set(OVER)) == 1  # neither green, for right, nor red, for wrong
    assert "white if over" in WORLD.picture_legend


def test_panels_are_read_as_they_are_drawn(generator):
    live = torch.randint(6, (50,), generator=generator)
    symbols = torch.randint(4, (50, 6), generator=generator)
    pixels = panel(live, symbols)
    noise = 0.1 * torch.randn(pixels.shape, generator=generator)
    for given in (pixels, pixels + noise):
        found = read_panel(given)
        assert torch.equal(found[0], live) and torch.equal(found[1], symbols)


def test_a_state_is_behind_its_observation_and_nearest_to_itself(generator):
    state = WORLD.initial(40, generator)
    for _ in range(4):
        observation = WORLD.observe(state)
        behind = WORLD.state_behind(observation)
        again = WORLD.observe(behind)
        near = WORLD.nearest(
            {
                name: value + 0.1 * torch.rand(value.shape, generator=generator)
                for name, value in observation.items()
            }
        )
        for name, value in observation.items():
            torch.testing.assert_close(again[name], value)
            torch.testing.assert_close(near[name], value)
        assert not any(bool(broken.any()) for broken in WORLD.faults(observation).values())
        # Later stages are taken to be like this one.
        assert torch.equal(behind.live[:, 0], behind.live[:, 2])
        action = torch.randint(1, 5, (40,), generator=generator)
        state = WORLD.transition(state, action)


@pytest.mark.parametrize(
    ("name", "place", "value", "rule"),
    [
        ("ego", 0, 4.0, "stage has to be"),
        ("ego", 0, 0.5, "stage has to be"),
        ("ego", 1, -1.0, "since has to be"),
        ("verbal", 0, 2.0, "kind has to be"),
        ("visual", 0, 0.5, "one terminal has to be lit"),
    ],
)
def test_what_cannot_be_breaks_its_rule(name, place, value, rule):
    observation = WORLD.observe(bomb("A", "cross"))
    broken = observation[name].clone()
    broken.view(-1)[place] = value
    faults = WORLD.faults({**observation, name: broken})
    assert [text for text, fault in faults.items() if bool(fault)][0].startswith(rule)


def learned(knowledge, state, shown=(), said=False):
    visible = {
        "visual": torch.tensor([k in shown for k in range(6)]),
        "verbal": torch.tensor([said]),
    }
    return WORLD.learn(knowledge, WORLD.observe(state), visible, lambda supposed: visible)


def test_terminals_are_known_until_the_next_stage_and_the_type_for_good():
    states, _ = play(bomb("A", "cross", "plus"), [WAIT, RED, WAIT])
    knowledge = WORLD.nothing_known()
    seen = []
    for state, shown, said in zip(states, [(1,), (2,), (), (0,)], [0, 1, 0, 0], strict=True):
        knowledge = learned(knowledge, state, shown, bool(said))
        known = WORLD.known(knowledge)
        seen.append((known["visual"].nonzero().flatten().tolist(), known["verbal"].tolist()))
    assert seen == [([1], [False]), ([1, 2], [True]), ([], [True]), ([0], [True])]


def test_settings_hide_the_type_and_nothing_else():
    observation = WORLD.observe(start())
    for setting, heard in (("labelled", True), ("unlabelled", False)):
        visible = WORLD.visibility(setting, observation)
        assert visible["visual"].all()
        assert (visible["verbal"] == heard).all()
    with pytest.raises(
        UnknownNameError, match='"fog" in bomb_defusal; known: labelled, unlabelled'
    ):
        WORLD.visibility("fog", observation)


def test_relevant_are_the_lit_terminal_and_the_type():
    state = start(30)
    ((name, relevant),) = WORLD.relevance(WORLD.observe(state)).items()
    assert name == "terminal_and_type"
    assert relevant["visual"].sum(-1).tolist() == [1] * 30
    assert torch.equal(relevant["visual"].long().argmax(-1), state.live[:, 0])
    assert relevant["verbal"].all()
    over = replace(state, stage=torch.full((30,), 3))
    ((_, relevant),) = WORLD.relevance(WORLD.observe(over)).items()
    assert not relevant["visual"].any() and not relevant["verbal"].any()


def test_costs_are_those_of_the_supplement():
    visual, verbal = WORLD.modalities
    assert float(visual.cost(torch.tensor(2))) == pytest.approx(1.2)
    assert float(verbal.cost(torch.tensor(1))) == pytest.approx(0.5)
    communicable = WORLD.communicable(WORLD.observe(start()))
    assert communicable["visual"].shape == (8, 6) and communicable["verbal"].shape == (8, 1)
    assert verbal.understand("type  b BOMB") == (0, 1)
    with pytest.raises(UnknownNameError, match='"Type C bomb"; known: Type A bomb, Type B bomb'):
        verbal.understand("Type C bomb")


def test_things_have_words():
    observation = WORLD.observe(bomb("B", "plus"))
    assert WORLD.describe(observation, "verbal", "type") == "Type B bomb"
    assert WORLD.describe(observation, "visual", "terminal 1") == "terminal 1 (lit, plus)"
    assert WORLD.describe(observation, "visual", "terminal 4") == "terminal 4 (bars)"
    assert WORLD.deed(observation, None, WAIT) == "wait"
    assert [WORLD.deed(observation, None, 1 + k) for k in range(4)] == [
        f"press {button}" for button in BUTTONS
    ]


def test_symbols_are_what_networks_read():
    observation = WORLD.observe(start())
    for name, value in WORLD.symbols(observation).items():
        assert value.shape[-1] == WORLD.symbol_sizes[name]
    assert torch.equal(WORLD.symbols(observation)["verbal"].sum((-1, -2)), torch.ones(8))
    direction, distance = WORLD.distance(observation)
    assert not direction.any() and not distance.any()
    items, _ = WORLD.assume(WORLD.nothing_known(8), observation)
    assert items == {}
    assert list(itertools.islice(WORLD.actions, 1)) == ["wait"]

"""Decisions: the message in all forms, the table of alternatives, what mattered, and why."""

from dataclasses import replace

import pytest
import torch
from example_person import CHANNELS, DOMAIN, begun, flags, plan

from mirror_ppl.communication import Decision, Gain, Valued
from mirror_ppl.communication.decision import gain_over_silence
from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.search import Found
from mirror_ppl.domains.bomb_defusal import BombDefusal, BombState

SHOWN, SAID = flags(visual=["front-left"]), flags(verbal=["front-left"])
OTHER = flags(verbal=["rear-right"])
AHEAD = "front car in the left lane, 3 cells ahead, closing"
BEHIND = "rear car in the right lane, 3 cells behind, closing"
TWO_DRAWS = 6.3138
"""The .95 quantile of Student's t of two draws."""


def decision(chosen, candidates, utility, actions=None):
    """With a car ahead in the own lane and one behind in the other; both close in."""
    now = begun(0, [3, 9, -9, -3], [-1, 1, -1, 1]).now
    values = Valued(torch.tensor(utility), None if actions is None else torch.tensor(actions))
    found = Found(torch.stack(candidates), values)
    flags_ = found.candidates[chosen, 0]
    gain = gain_over_silence(values, chosen)
    message = CHANNELS.message(flags_)
    return Decision(message, flags_, gain, DOMAIN, now, found, chosen, DOMAIN, standard_errors=2.0)


def four(chosen=3, actions=None):
    candidates = [plan(None, None), plan(SHOWN, None), plan(OTHER, None), plan(SHOWN | OTHER, None)]
    return decision(chosen, candidates, [[0.0, 0], [1, 1], [2.0, 4], [3, 4]], actions)


def test_the_message_in_all_forms():
    one = four()
    assert str(one.message) == "visual: front-left; verbal: rear-right"
    assert one.told["visual"].tolist() == [True, False, False, False]
    assert one.told["verbal"].tolist() == [False, False, False, True]
    assert one.cost == pytest.approx(0.04)
    assert [str(message) for message in one.plan] == [str(one.message), "silence"]
    later = decision(1, [plan(None, None, None), plan(None, SAID, OTHER)], [[0.0], [1.0]])
    assert [str(message) for message in later.plan] == [
        "silence",
        "verbal: front-left",
        "verbal: rear-right",
    ]
    assert later.cost == 0


def test_the_table_of_alternatives():
    # Now, and in the next step, which is not shown.
    actions = [[[stay, 1 - stay], [0.6, 0.4]] for stay in (0.9, 0.8, 0.5, 0.25)]
    candidates = [plan(None, None), plan(SHOWN, SAID | OTHER), plan(OTHER, None), plan(SAID, None)]
    table = decision(2, candidates, [[0.0, 0], [1, -2], [3, 4], [0, 0]], actions).alternatives
    assert list(table.columns) == [
        "message",
        "later",
        "cost",
        "gain",
        "standard_error",
        "low",
        "high",
        "probability",
        "chosen",
        "p(stay)",
        "p(switch)",
    ]
    # The best first; of equally good ones the one that was valued first.
    assert table.index.tolist() == [2, 0, 3, 1]
    assert table["message"].tolist() == [
        "verbal: rear-right",
        "silence",
        "verbal: front-left",
        "visual: front-left",
    ]
    assert table["later"].tolist() == ["", "", "", "in 1 step: verbal: front-left, rear-right"]
    assert table["cost"].tolist() == pytest.approx([0.03, 0, 0.03, 0.01 + 0.12])
    assert table["gain"].tolist() == pytest.approx([3.5, 0, 0, -0.5])
    error = [0.5, 0, 0, 1.5]
    assert (table["high"] - table["gain"]).tolist() == pytest.approx(
        [TWO_DRAWS * e for e in error], rel=1e-4
    )
    assert table["standard_error"].tolist() == pytest.approx(list(error))
    assert (table["gain"] - table["low"]).tolist() == pytest.approx(
        [TWO_DRAWS * e for e in error], rel=1e-4
    )
    assert table["probability"].tolist() == [1.0, 0.0, 0.0, 0.5]
    assert table["chosen"].tolist() == [True, False, False, False]
    assert table["p(stay)"].tolist() == pytest.approx([0.5, 0.9, 0.25, 0.8])
    assert table["p(switch)"].tolist() == pytest.approx([0.5, 0.1, 0.75, 0.2])


def test_what_each_item_adds():
    assert four().matters == pytest.approx(
        {("visual", "front-left"): 0.5, ("verbal", "rear-right"): 2.5}
    )
    assert four(1).matters == pytest.approx({("visual", "front-left"): 1.0})
    assert four(0).matters == {}
    # It is left out now alone: what comes later stays the same, whatever that is.
    again = [plan(None, None), plan(SHOWN, SHOWN), plan(None, SHOWN), plan(SHOWN, None)]
    twice = decision(1, again, [[0.0], [3.0], [1.0], [2.5]])
    assert twice.matters == pytest.approx({("visual", "front-left"): 2.0})
    # Items without which nothing was valued are not there.
    candidates = [plan(None, None), plan(SHOWN | SAID, OTHER), plan(SHOWN, None), plan(SAID, OTHER)]
    partly = decision(1, candidates, [[0.0], [3.0], [2.0], [2.5]])
    assert partly.matters == pytest.approx({("visual", "front-left"): 0.5})


def test_advice_follows_the_rules_that_the_robot_learned():
    """Type A, a frame on terminal 3: yellow holds, blue was taught."""
    world = BombDefusal()
    state = BombState(
        stage=torch.tensor(1),
        since=torch.tensor(4),
        kind=torch.tensor(0),
        live=torch.tensor([2, 2, 2]),
        symbols=torch.full((3, 6), 2),
    )
    now, none = world.observe(state), torch.zeros(7, dtype=torch.bool)
    gain, silence = Gain(0.0, 0.0, 0.0), Channels(world).message(none)
    one, taught = (
        Decision(silence, none, gain, world, now, None, 0, known)
        for known in (world, world.as_believed)
    )
    assert one.advice == "press yellow: terminal 3 (lit, frame), and Type A bomb"
    assert taught.advice == "press blue: terminal 3 (lit, frame), and Type A bomb"
    assert Decision(silence, none, gain, world, now, None, 0, world, True).advice == (
        "the round is over"
    )


def test_advice_in_driving_is_about_cars_in_the_way():
    """A car three cells ahead comes closer: switch. Without one, stay."""
    none, gain = flags(), Gain(0.0, 0.0, 0.0)
    for ahead, expected in ((3, "switch lanes: front car in the left lane"), (30, "stay")):
        now = begun(0, [ahead, 30, -30, -30], [-1, 1, -1, -1]).now
        one = Decision(CHANNELS.message(none), none, gain, DOMAIN, now, None, 0, DOMAIN)
        assert one.advice.startswith(expected)


def test_a_decision_without_a_choice():
    """Where nothing could be told, there is silence and nothing more."""
    now = begun(0, [30, 30, -30, -30], [1, 1, -1, -1]).now
    none = Gain(0.0, 0.0, 0.0)
    one = Decision(CHANNELS.message(flags()), flags(), none, DOMAIN, now, None, 0, DOMAIN)
    assert one.plan == (one.message,)
    assert one.cost == 0
    assert one.matters == {}
    assert one.turning_point is None
    assert one.why() == "silence: there is nothing new to communicate now"
    (row,) = one.alternatives.to_dict("records")
    assert row == {
        "message": "silence",
        "later": "",
        "cost": 0.0,
        "gain": 0.0,
        "standard_error": 0.0,
        "low": 0.0,
        "high": 0.0,
        "probability": 0.0,
        "chosen": True,
    }


# --- the turning point ------------------------------------------------------------------------


def turned(silent, told):
    """A decision to show the car ahead, with probabilities of actions at each step."""
    return decision(1, [plan(None), plan(SHOWN)], [[0.0, 0], [1, 1]], [silent, told])


@pytest.mark.parametrize(
    ("silent", "told", "expected"),
    [
        # It makes staying less probable at once.
        ([[0.9, 0.1], [0.9, 0.1]], [[0.2, 0.8], [0.9, 0.1]], (0, 0, 0.9, 0.2)),
        # It makes switching less probable.
        ([[0.3, 0.7], [0.9, 0.1]], [[0.8, 0.2], [0.9, 0.1]], (0, 1, 0.7, 0.2)),
        # A little at first, much afterwards.
        ([[0.9, 0.1], [0.8, 0.2]], [[0.7, 0.3], [0.2, 0.8]], (1, 0, 0.8, 0.2)),
        # The first that is at least half of the largest.
        ([[0.9, 0.1], [0.8, 0.2]], [[0.55, 0.45], [0.2, 0.8]], (0, 0, 0.9, 0.55)),
        # What is followed of later steps does not add up to one.
        ([[1.0, 0.0], [0.4, 0.1]], [[1.0, 0.0], [0.1, 0.7]], (1, 0, 0.8, 0.125)),
    ],
)
def test_where_a_message_changes_most(silent, told, expected):
    assert turned(silent, told).turning_point == pytest.approx(expected)


def test_silence_turns_nothing():
    assert four(0, [[[0.9, 0.1]]] * 4).turning_point is None
    assert four(3).turning_point is None  # the objective did not look at actions


# --- why --------------------------------------------------------------------------------------


def test_why_silence():
    useless = decision(0, [plan(None), plan(SAID)], [[0.0, 0], [-1, 0]])
    assert useless.why() == "silence: no message is worth its cost"
    unsure = decision(0, [plan(None), plan(SAID)], [[0.0, 0], [3, -1]])
    assert unsure.why() == (
        "silence: no message is reliably worth its cost (the best gains +1.00 [-11.63, +13.63])"
    )


def test_why_silence_says_which_rule_asks_for_it():
    """A gain of 1 with a standard error of .5."""
    part = 0.5 * 7**0.5
    gains = [[0.0] * 8, [1 + part, 1 - part] * 4]
    one = replace(decision(0, [plan(None), plan(SAID)], gains), standard_errors=2.5)
    text = "silence: no message is reliably worth its cost (the best gains +1.00 [+0.05, +1.95]"
    assert one.why() == f"{text}, fewer than 2.5 standard errors)"
    one = replace(one, standard_errors=1.5)
    assert one.why() == text.replace("message", "item of a message") + ")"
    # The one with the largest mean is uncertain, another one is not.
    both = decision(0, [plan(None), plan(SAID), plan(SHOWN)], [*gains, [0.9, 0.8] * 4])
    assert replace(both, standard_errors=2.5).why().startswith("silence: no item of a message")


@pytest.mark.parametrize(
    ("wait", "steps"), [([None, SAID, None], "1 step"), ([None, None, SAID], "2 steps")]
)
def test_why_waiting(wait, steps):
    one = decision(1, [plan(None, None, None), plan(*wait)], [[0.0, 0], [1, 1]], [[[0.5, 0.5]]] * 2)
    assert one.why() == f"silence: {AHEAD}: can wait {steps}"


@pytest.mark.parametrize(
    ("silent", "told", "what"),
    [
        (
            [[0.9, 0.1]],
            [[0.2, 0.8]],
            "stay in its way with probability 0.90; with the message, 0.20",
        ),
        (
            [[0.25, 0.75]],
            [[0.5, 0.5]],
            "switch lanes with probability 0.75; with the message, 0.50",
        ),
        (
            [[0.5, 0.5], [0.9, 0.1]],
            [[0.5, 0.5], [0.2, 0.8]],
            "stay in their lane in 1 step with probability 0.90; with the message, 0.20",
        ),
        (
            [[0.5, 0.5], [0.5, 0.5], [0.9, 0.1]],
            [[0.5, 0.5], [0.5, 0.5], [0.2, 0.8]],
            "stay in their lane in 2 steps with probability 0.90; with the message, 0.20",
        ),
    ],
)
def test_why_a_message(silent, told, what):
    assert turned(silent, told).why() == f"{AHEAD}: they would {what} (gain +1.00)"


def test_why_names_what_the_plan_sends_later_since_the_gain_is_of_both():
    later = decision(
        1,
        [plan(None, None), plan(SAID, SHOWN)],
        [[0.0, 0], [1, 1]],
        [[[0.9, 0.1]] * 2, [[0.2, 0.8]] * 2],
    )
    assert later.why().endswith(f"0.20 (gain +1.00 with what follows in 1 step: {AHEAD})")


def test_why_where_no_action_changes_much():
    assert turned([[0.9, 0.1]], [[0.895, 0.105]]).why() == (
        f"{AHEAD}: slightly changes what they do in the steps ahead (gain +1.00)"
    )


def test_the_item_that_matters_most_comes_first_and_the_action_is_about_it():
    actions = [[[0.1, 0.9]]] + [[[0.6, 0.4]]] * 3
    one = four(3, actions)
    assert one.why() == (
        f"{BEHIND}, and {AHEAD}: they would switch into that lane with probability 0.90; "
        "with the message, 0.40 (gain +3.50)"
    )


def test_a_car_is_named_once_though_it_is_shown_and_spoken_of():
    both = [plan(None), plan(SHOWN | SAID)]
    one = decision(1, both, [[0.0], [1.0]], [[[0.9, 0.1]], [[0.2, 0.8]]])
    assert one.why().count(AHEAD) == 1


def test_why_where_the_objective_does_not_look_at_actions():
    assert four(1).why() == f"{AHEAD}: brings their belief closer to the truth"

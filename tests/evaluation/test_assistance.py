"""Pairing people with communicators: what is played, counted and logged."""

import json
import math
from dataclasses import asdict, replace

import pytest
import torch

from mirror_ppl.communication import rules
from mirror_ppl.communication.decision import Decision, Gain
from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.objectives import Valued
from mirror_ppl.communication.search import Found
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.driving import Driving, DrivingState
from mirror_ppl.domains.driving.people import Memory, TaskDrivers
from mirror_ppl.domains.highway import Highway
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.evaluation.assistance import (
    COMMUNICATORS,
    Listener,
    PlannerOptions,
    audit,
    listeners,
    play,
    play_together,
    speaker,
)
from mirror_ppl.evaluation.assistance_cells import turns
from mirror_ppl.people import draw_starts, simulated_people
from mirror_ppl.people.recordings import Start

DOMAIN = Driving()
CHANNELS = Channels(DOMAIN)
FOG = (2.0, 2.0, 0.0, 0.0)


def driver(consistency=1.0, reach=FOG):
    return TaskDrivers(torch.tensor([reach]), torch.tensor([consistency]))


def listener(rounds=20, seed=0):
    return Listener(DOMAIN, "fog", driver(), draw_starts(1, rounds, seed, "assistance"))


# --- one scene by hand ------------------------------------------------------------------------

# Two rounds of three steps. Noise 0 makes a driver switch whatever they think, noise 1 stay.
#
# First round; front-left and front-right, rear-left and rear-right as they are before each step:
#   lane 0   3  11 -11  -2   stay      then front-left is 2 cells ahead: -2
#   lane 0   2  12 -12  -1   switch    -1, and rear-right is in the same cell: -2 - 5
#   lane 1   1  13 -13   0   stay      then rear-right is 1 cell ahead: -2
# Second round: nobody on the road. Switch: -1.
START = DrivingState(
    torch.tensor([[0, 1]]),
    torch.tensor([[[3, 11, -11, -2], [30, 30, -30, -30]]]),
    torch.tensor([[[-1, 1, -1, 1], [1, 1, -1, -1]]]),
)
LUCK = torch.tensor([[[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]])
SCRIPT = {
    0: {"visual": ("front-left", "front-right"), "verbal": ("rear-right",)},
    2: {"verbal": ("front-left", "rear-right")},
}


class Scripted:
    """Says what is in a script in the first of two rounds; remembers what it was given."""

    def __init__(self, script):
        self.script = script
        self.given = []

    def __call__(self, rounds, truth):
        self.given.append(rounds)
        flags = torch.zeros(len(rounds), len(CHANNELS), dtype=torch.bool)
        flags[0] = CHANNELS.flags(self.script.get(rounds[0].time, {}))
        return flags, None


@pytest.fixture
def scene(monkeypatch):
    monkeypatch.setattr(Driving, "horizon", 3)
    start = Start(START, torch.zeros(1, 2, dtype=torch.long), LUCK)
    return Listener(DOMAIN, "fog", driver(), start)


@pytest.fixture
def played(scene):
    return play(scene, Scripted(SCRIPT), keep_log=True)


def test_rewards_costs_and_collisions_are_those_of_the_scene(played):
    assert played.task == pytest.approx([-2 - 8 - 2, -1])
    assert played.cost == pytest.approx([0.01 * 4 + 0.03 * 1 + 0.03 * 4, 0])
    assert played.net == pytest.approx([-12.19, -1])
    assert played.mishaps == [1, 0]
    assert played.steps == 2 * DOMAIN.horizon
    assert played.milliseconds >= 0


def test_items_and_opportunities_are_counted_by_modality(played):
    assert played.items == {"visual": [2, 0], "verbal": [3, 0]}
    # On the road: 4, 2 and 2 cars; of these ahead or abreast 2, 1 and 2.
    assert played.communicable == {"visual": 5, "verbal": 8}
    assert played.rates() == {"visual": 2 / 5, "verbal": 3 / 8}


def test_relevant_items_are_counted_by_notion_and_modality(played):
    # At first only front-left is closing in on the ego's lane, at last only rear-right, abreast;
    # both are closing in all the time. Front-right draws away.
    assert played.relevant == {
        "collision_course": {"visual": [1, 0], "verbal": [1, 0]},
        "closing": {"visual": [1, 0], "verbal": [3, 0]},
    }


def test_speakers_are_given_the_rounds_as_they_went(scene):
    say = Scripted(SCRIPT)
    play(scene, say)
    assert [[past.time for past in rounds] for rounds in say.given] == [[0, 0], [1, 1], [2, 2]]
    first, second = say.given[-1]
    assert first.actions.tolist() == [0, 1]
    assert second.actions.tolist() == [1, 0]
    assert first.observation["visual"][:, :, 0].tolist() == [
        [3, 11, -11, -2],
        [2, 12, -12, -1],
        [1, 12, -12, 0],
    ]
    assert first.observation["ego"].tolist() == [[0], [0], [1]]
    assert first.told["visual"].tolist() == [[True, True, False, False], [False] * 4]
    assert first.told["verbal"].tolist() == [[False, False, False, True], [False] * 4]
    assert not any(mask.any() for mask in second.told.values())


def test_the_log_has_every_decision_and_the_probability_of_the_action(scene, played):
    assert [(entry["step"], entry["round"]) for entry in played.log] == [
        (step, number) for step in range(3) for number in range(2)
    ]
    first = [entry for entry in played.log if entry["round"] == 0]
    assert first[0]["message"] == {key: list(items) for key, items in SCRIPT[0].items()}
    assert first[1]["message"] == {"visual": [], "verbal": []}
    assert [entry["cost"] for entry in first] == pytest.approx([0.07, 0, 0.12])
    assert [entry["action"] for entry in first] == ["stay", "switch", "stay"]
    # What was said reached the driver: their choices are those of a person who received it.
    memory, state = Memory.empty((1,)), DrivingState(*(part[:, 0] for part in vars(START).values()))
    for step, entry in enumerate(first):
        told = CHANNELS.split(CHANNELS.flags(SCRIPT.get(step, {}))[None])
        probabilities, memory = scene.driver.step(memory, DOMAIN.observe(state), told)
        expected = dict(zip(DOMAIN.actions, probabilities[0].tolist(), strict=True))
        assert entry["true_probability"] == pytest.approx(expected)
        state = DOMAIN.transition(state, torch.tensor([DOMAIN.actions.index(entry["action"])]))
    assert json.loads(json.dumps(played.log)) == played.log
    quiet = play(scene, Scripted({}), keep_log=True).log
    assert quiet[0]["true_probability"] != first[0]["true_probability"]


def test_a_log_is_kept_only_if_asked_for(scene, played):
    again = play(scene, Scripted(SCRIPT))
    assert again.log == []
    assert without_time(again) == without_time(played)


def test_action_noise_decides_by_the_probability_of_switching(scene):
    entry = play(scene, Scripted({}), keep_log=True).log[0]
    chance = entry["true_probability"]["switch"]
    assert 0.01 < chance < 0.99
    for action_noise, action in ((chance - 1e-3, "switch"), (chance + 1e-3, "stay")):
        start = Start(START, scene.start.scenario, torch.full((1, 2, 3), action_noise))
        log = play(Listener(DOMAIN, "fog", driver(), start), Scripted({}), keep_log=True).log
        assert log[0]["action"] == action


# --- the same for all -------------------------------------------------------------------------


def without_time(played):
    data = asdict(replace(played, log=[]))
    assert data.pop("milliseconds") >= 0
    return data


def run(name, rates=None, seed=0, rounds=20):
    someone = listener(rounds)
    return play(someone, speaker(name, someone, PlannerOptions(), seed, rates))


def test_all_play_the_same_rounds_with_the_same_action_noise():
    silence = run("none")
    assert without_time(run("none", seed=1)) == without_time(silence)
    torch.manual_seed(1)  # nothing global matters
    flags = torch.zeros(20, len(CHANNELS), dtype=torch.bool)
    assert without_time(play(listener(), lambda rounds, truth: (flags, None))) == without_time(
        silence
    )
    never = {"visual": 0.0, "verbal": 0.0}
    assert without_time(run("random", never)) == without_time(silence)
    assert without_time(run("random", {"visual": 1.0, "verbal": 1.0})) == without_time(run("all"))
    # Cars' courses depend on no person, so all have the same opportunities to speak of them.
    for name in ("all", "nearest", "oracle"):
        assert run(name, rounds=5).communicable == run("none", rounds=5).communicable
    other = play(listener(seed=1), lambda rounds, truth: (flags, None))
    assert without_time(other) != without_time(silence)


@pytest.mark.parametrize("name", ["none", "all", "nearest", "oracle"])
def test_people_who_play_together_play_as_each_alone(name):
    reach = torch.tensor([FOG, (5.0, 5.0, 3.0, 3.0), (0.0, 1.0, 0.0, 9.0)])
    everybody = TaskDrivers(reach, torch.tensor([1.0, 0.5, 4.0]))
    people = listeners(everybody, 3, "fog", 4, 7)
    says = [speaker(name, one, PlannerOptions(), 0) for one in people]
    together = play_together(people, says, keep_log=True)
    for found, one in zip(together, people, strict=True):
        alone = play(one, speaker(name, one, PlannerOptions(), 0), keep_log=True)
        assert without_time(found) == without_time(alone)
        assert found.log == alone.log
    assert len({tuple(found.task) for found in together}) == 3


@pytest.mark.parametrize("world", ["search_rescue", "bomb_defusal", "highway"])
def test_rounds_of_people_who_play_together_may_end_at_different_steps(world, monkeypatch):
    monkeypatch.setattr(Highway, "horizon", 2)
    setting = get_domain(world).settings[-1]
    everybody = simulated_people(world, setting, "diverse", 3, 7)
    people = listeners(everybody, 3, setting, 2, 7)
    says = [speaker("nearest", one, PlannerOptions(), 0) for one in people]
    together = play_together(people, says)
    for found, one in zip(together, people, strict=True):
        alone = play(one, speaker("nearest", one, PlannerOptions(), 0))
        assert found.task == pytest.approx(alone.task, abs=1e-4)
        assert (found.items, found.steps) == (alone.items, alone.steps)
    if world == "search_rescue":
        assert len({found.steps for found in together}) > 1


def test_people_are_divided_into_groups_that_play_together():
    found = turns(["none", "mirror", "random", "oracle"], "abcdefg")
    numbers = {one.communicators: [] for one in found}
    for one in found:
        numbers[one.communicators].append(one.people)
    assert [*numbers] == [("oracle",), ("mirror", "random"), ("none",)]
    assert numbers[("none",)] == numbers[("oracle",)] == [tuple("abcde"), tuple("fg")]
    assert numbers[("mirror", "random")] == [tuple("ab"), tuple("cd"), tuple("ef"), ("g",)]
    assert found[0].label == "oracle, a, b, c, d, e"
    assert turns(["none"], "a")[0].label == "none, a"


def test_all_say_everything_and_none_nothing():
    everything, silence = run("all"), run("none")
    assert {name: sum(items) for name, items in everything.items.items()} == everything.communicable
    assert everything.rates() == {"visual": 1.0, "verbal": 1.0}
    assert silence.rates() == {"visual": 0.0, "verbal": 0.0}
    assert silence.cost == [0.0] * 20


def test_random_messages_have_the_rate_that_is_asked_for():
    rates = {"visual": 0.1, "verbal": 0.35}
    played = run("random", rates, rounds=100)
    for name, rate in rates.items():
        number = played.communicable[name]
        assert number > 1000
        # Each opportunity is taken or not: within 4 standard deviations, 1 seed of 16,000 fails.
        spread = math.sqrt(number * rate * (1 - rate))
        assert abs(sum(played.items[name]) - number * rate) < 4 * spread
    assert run("random", rates, seed=1, rounds=100).items != played.items


def test_nearest_says_each_car_once_and_only_hidden_ones():
    someone = listener()
    say = speaker("nearest", someone, PlannerOptions(), 0)
    rounds_at_last = []

    def spy(rounds, truth):
        rounds_at_last[:] = rounds
        return say(rounds, truth)

    play(someone, spy)
    told = torch.stack([past.told["verbal"] for past in rounds_at_last])
    assert told.sum(1).max() == 1 and told.sum(-1).max() == 1
    assert told.any()
    for past in rounds_at_last:
        step, car = past.told["verbal"].nonzero(as_tuple=True)
        ahead = past.observation["visual"][step, car, 0]
        assert ((ahead < 0) | (ahead > 2)).all() and (ahead.abs() <= 6).all()
        assert torch.equal(
            rules.nearest(DOMAIN, past, "clear"), torch.zeros(len(CHANNELS), dtype=torch.bool)
        )


def test_communicators_that_are_not_there_are_refused():
    with pytest.raises(
        UnknownNameError, match='communicator "mirrors".*perhaps you meant "mirror"'
    ):
        run("mirrors")
    assert {"none", "random", "oracle"} < set(COMMUNICATORS)


# --- audits -----------------------------------------------------------------------------------


def decision(chosen):
    """A decision for one of three candidates: silence, front-left shown, front-left said."""
    state = DrivingState(torch.tensor(0), torch.tensor([3, 9, -9, -9]), torch.tensor([-1, 1, 1, 1]))
    candidates = torch.zeros(3, 1, len(CHANNELS), dtype=torch.bool)
    candidates[1, 0, 0] = candidates[2, 0, 4] = True
    utility = torch.tensor([[0.0, 0.0], [1.0, 0.5], [2.0, 1.0]])
    actions = torch.tensor([[[0.9, 0.1]], [[0.4, 0.6]], [[0.2, 0.8]]])
    flags = candidates[chosen, 0]
    gain = Gain(0.0, 0.0, 0.0) if chosen == 0 else Gain(1.5, 0.5, 1.0, 8)
    found = Found(candidates, Valued(utility, actions))
    message = CHANNELS.message(flags)
    return Decision(message, flags, gain, DOMAIN, DOMAIN.observe(state), found, chosen, DOMAIN)


def test_an_audit_is_the_decision_as_plain_data():
    told = audit(decision(2), most=2)
    assert json.loads(json.dumps(told, allow_nan=False)) == told
    assert told["gain"] == 1.5
    assert told["gain_interval"] == pytest.approx(
        [1.5 - 1.8946 * 0.5, 1.5 + 1.8946 * 0.5], abs=1e-4
    )
    assert told["matters"] == [["verbal", "front-left", 1.5]]
    turn = told["turning_point"]
    assert (turn["steps_ahead"], turn["action"]) == (0, "stay")
    assert (turn["silent"], turn["told"]) == pytest.approx((0.9, 0.2))
    assert "front car in the left lane, 3 cells ahead, closing" in told["why"]
    best, second = told["alternatives"]
    assert best["message"] == "verbal: front-left" and second["message"] == "visual: front-left"
    assert (best["gain"], best["cost"], best["later"]) == (1.5, pytest.approx(0.03), "")
    assert best["standard_error"] == pytest.approx(0.5)
    assert best["chosen"] and not second["chosen"]
    # The chosen one is there however few are shown.
    (chosen,) = [each for each in audit(decision(1), most=0)["alternatives"] if each["chosen"]]
    assert chosen["message"] == "visual: front-left"


def test_an_audit_of_silence_is_plain_data_too():
    told = audit(decision(0))
    assert json.loads(json.dumps(told, allow_nan=False)) == told
    assert told["turning_point"] is None
    assert told["matters"] == []
    assert [row["message"] for row in told["alternatives"]][-1] == "silence"
    assert told["why"].startswith("silence")


def test_the_log_holds_audits_where_there_are_decisions(scene):
    one = decision(2)
    log = play(scene, lambda rounds, truth: (torch.stack([one.flags] * 2), [one] * 2), True).log
    assert len(log) == 6
    for entry in log:
        assert entry["message"] == {"visual": [], "verbal": ["front-left"]}
        assert {key: entry[key] for key in audit(one)} == audit(one)

"""The oracle: against plain expectimax, played rounds, and other ways to speak; and what it merges.

Expectimax here goes through every message and every action with `SimulatedDrivers.step` on what
they remember exactly; the oracle merges equal knowledge on the way.
"""

import itertools
from dataclasses import fields, replace

import pytest
import torch

from mirror_ppl.communication.messages import Channels
from mirror_ppl.domains.base import map_state, total_reward
from mirror_ppl.domains.driving import CARS, Driving, DrivingState
from mirror_ppl.domains.driving.oracle import Oracle
from mirror_ppl.domains.driving.participants import simulated_drivers
from mirror_ppl.domains.driving.people import Memory, TaskDrivers, in_sight, remember
from mirror_ppl.evaluation.assistance import Listener, play
from mirror_ppl.people import draw_starts

DOMAIN = Driving()
CHANNELS = Channels(DOMAIN)
SILENCE = (False,) * len(CHANNELS)
FOG, EVERYTHING, NOTHING = (2.0, 2.0, 0.0, 0.0), (12.0,) * 4, (-1.0,) * 4


def driver(reach=FOG, consistency=3.0):
    return TaskDrivers(torch.tensor([reach]), torch.tensor([consistency]))


def scenes(*cars, lane=0):
    """States ``[R]`` of rounds; each car is a pair of position and speed."""
    lanes = lane if isinstance(lane, tuple) else (lane,) * len(cars)
    position, speed = torch.tensor(cars).unbind(-1)
    return DrivingState(torch.tensor(lanes), position, speed)


AWAY, GONE = (30, 1), (-30, -1)
# A car ahead and one behind on the road, so that at most eight messages can be sent at a step.
FEW = scenes(
    ((2, -1), AWAY, GONE, (-2, 1)),
    ((2, 1), AWAY, (-3, 1), GONE),  # the one ahead seems to close in at first sight
    (AWAY, (2, -1), GONE, (-1, -1)),
    lane=(0, 0, 1),
)
ALL = scenes(
    ((2, -1), (3, 1), (-1, -1), (-2, 1)), ((1, 1), (2, -1), (-3, 1), (-1, -1)), lane=(0, 1)
)


@pytest.fixture
def horizon(monkeypatch):
    """A function that makes rounds shorter."""
    return lambda steps: monkeypatch.setattr(Driving, "horizon", steps)


def one(part, index):
    """One of several rounds or memories, ``[1]``."""
    return map_state(lambda value: value[index : index + 1], part)


def messages(observation):
    """Every message that may be sent, as rows of flags ``[C, N]``, silence among them."""
    allowed = DOMAIN.communicable(observation)
    choices = [(False, True)[: 1 + int(may)] for name in allowed for may in allowed[name][0]]
    return torch.tensor(list(itertools.product(*choices)))


def listen(person, state, memory, flags):
    """Probabilities ``[C, A]`` and memories ``[1, C, K]`` after each of C messages."""
    number = len(flags)
    observation = {
        name: value[:, None].expand(-1, number, *value.shape[1:])
        for name, value in DOMAIN.observe(state).items()
    }
    told = {"visual": flags[None, :, :4], "verbal": flags[None, :, 4:]}
    memory = map_state(lambda part: part[:, None].expand(-1, number, -1), memory)
    probability, memory = person.step(memory, observation, told)
    return probability[0], memory


def price(message):
    return 0.01 * sum(message[:4]) ** 2 + 0.03 * sum(message[4:]) ** 2


def best_value(person, state, memory, steps):
    """Expected return of the best messages for one round: expectimax without shortcuts."""
    if steps == 0:
        return 0.0
    flags = messages(DOMAIN.observe(state))
    probability, known = listen(person, state, memory, flags)
    following, rewards = outcomes(state)
    worth = []
    for number, message in enumerate(flags.tolist()):
        after = map_state(lambda part, number=number: part[:, number], known)
        rest = [best_value(person, next_, after, steps - 1) for next_ in following]
        worth.append(-price(message) + mean(probability[number], rewards, rest))
    return max(worth)


def outcomes(state):
    """What each action leads to, and its reward."""
    following, rewards = [], []
    for action in torch.arange(2)[:, None]:
        following.append(DOMAIN.transition(state, action))
        rewards.append(total_reward(DOMAIN.rewards(state, action, following[-1])).item())
    return following, rewards


def mean(probability, rewards, rest):
    parts = zip(probability.tolist(), rewards, rest, strict=True)
    return sum(chance * (reward + value) for chance, reward, value in parts)


def value_of(person, state, say, steps, memory=None, past=()):
    """Expected return of one round ``[1]`` in which ``say`` maps past actions to a message."""
    if steps == 0:
        return 0.0
    message = say(past, state)
    memory = Memory.empty((1,)) if memory is None else memory
    probability, known = listen(person, state, memory, torch.tensor([message]))
    following, rewards = outcomes(state)
    after = map_state(lambda part: part[:, 0], known)
    rest = [
        value_of(person, following[action], say, steps - 1, after, (*past, action))
        for action in (0, 1)
    ]
    return -price(message) + mean(probability[0], rewards, rest)


def silence(past, state):
    return SILENCE


def everything(past, state):
    return tuple(messages(DOMAIN.observe(state))[-1].tolist())


def own(oracle):
    """What the oracle of a single round says."""
    return lambda past, state: tuple(
        oracle.messages(torch.tensor(past, dtype=torch.long)[None])[0].tolist()
    )


# --- value ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reach", "consistency"),
    [(NOTHING, 4.0), (FOG, 2.0), ((1.0, 3.0, 2.0, 1.0), 0.5)],
)
def test_the_value_is_that_of_expectimax(horizon, reach, consistency):
    horizon(3)
    person = driver(reach, consistency)
    expected = [best_value(person, one(FEW, r), Memory.empty((1,)), 3) for r in range(3)]
    torch.testing.assert_close(Oracle(person, FEW).value, torch.tensor(expected), rtol=0, atol=1e-4)


def test_the_value_is_that_of_expectimax_with_every_message(horizon):
    horizon(2)
    person = driver(consistency=2.0)
    assert len(messages(DOMAIN.observe(one(ALL, 0)))) == 64
    expected = [best_value(person, one(ALL, r), Memory.empty((1,)), 2) for r in range(2)]
    torch.testing.assert_close(Oracle(person, ALL).value, torch.tensor(expected), rtol=0, atol=1e-4)


def forgetful(memory):
    """A form of knowledge that loses whether a speed is an assumption."""
    return replace(memory, assumed=torch.zeros_like(memory.assumed), age=memory.age * 0)


def test_expectimax_would_notice_knowledge_that_gets_lost(horizon, monkeypatch):
    horizon(3)
    person = driver(consistency=2.0)
    right = Oracle(person, FEW).value
    monkeypatch.setattr(Memory, "canonical", forgetful)
    assert not torch.allclose(Oracle(person, FEW).value, right, rtol=0, atol=1e-3)


def test_its_messages_attain_its_value(horizon):
    horizon(4)
    person = driver()
    for index in range(3):
        start = one(FEW, index)
        oracle = Oracle(person, start)
        attained = value_of(person, start, own(oracle), 4)
        assert attained == pytest.approx(oracle.value.item(), abs=1e-4)


def test_no_other_way_to_speak_is_better(horizon, generator):
    horizon(6)
    start = DOMAIN.initial(3, generator)
    for person in (driver(), driver(NOTHING, 1.0)):
        value = Oracle(person, start).value
        for say in (silence, everything):
            others = [value_of(person, one(start, r), say, 6) for r in range(3)]
            gain = value - torch.tensor(others)
            assert (gain > -1e-4).all()
            assert gain.max() > 0.05


def test_rounds_do_not_disturb_each_other(horizon, generator):
    horizon(5)
    start = DOMAIN.initial(7, generator)
    together = Oracle(driver(), start)
    actions = torch.randint(2, (7, 4), generator=generator)
    for index in range(7):
        alone = Oracle(driver(), one(start, index))
        torch.testing.assert_close(alone.value, together.value[index : index + 1])
        for time in range(5):
            said = together.messages(actions[:, :time])[index]
            assert torch.equal(alone.messages(actions[index : index + 1, :time])[0], said)


def test_the_value_is_what_played_rounds_are_worth_on_average(generator):
    """A simulated person, whole rounds; the mean of 300 within 4 of its standard errors."""
    person = simulated_drivers("fog", "paper", 2, 0).select([1])
    start = draw_starts(1, 6, 3, "oracle")
    oracle = Oracle(person, map_state(lambda part: part[0], start.state))

    def say(rounds):
        return oracle.messages(torch.stack([past.actions for past in rounds])), None

    # The same six rounds fifty times at once: the oracle is asked for six at a time.
    def say_all(rounds, _):
        parts = [say(rounds[first : first + 6])[0] for first in range(0, len(rounds), 6)]
        return torch.cat(parts), None

    state = map_state(lambda part: part.repeat(1, 50, *[1] * (part.dim() - 2)), start.state)
    action_noise = torch.rand(1, 300, DOMAIN.horizon, generator=generator)
    often = replace(start, state=state, action_noise=action_noise)
    played = play(Listener(DOMAIN, "fog", person, often), say_all)
    surplus = torch.tensor(played.net).view(50, 6) - oracle.value
    error = (surplus.var(0) / 50).sum().sqrt() / 6
    assert error < 0.2
    assert abs(surplus.mean()) < 4 * error


# --- silence ----------------------------------------------------------------------------------


def said(oracle, rounds, steps):
    """How many items the oracle communicates whatever the person does, over all steps."""
    return sum(
        int(oracle.messages(torch.tensor(past, dtype=torch.long).expand(rounds, time)).sum())
        for time in range(steps)
        for past in itertools.product((0, 1), repeat=time)
    )


def test_in_clear_weather_with_nothing_at_stake_it_is_silent(horizon):
    horizon(6)
    start = scenes((AWAY, (8, 1), GONE, GONE))
    assert len(messages(DOMAIN.observe(start))) == 4
    assert said(Oracle(driver(EVERYTHING, 8.0), start), 1, 6) == 0


def test_people_who_would_crash_get_a_message(horizon):
    horizon(6)
    start = scenes(((2, -1), AWAY, GONE, GONE))
    person = driver(NOTHING, 8.0)
    oracle = Oracle(person, start)
    first = CHANNELS.message(oracle.messages(torch.zeros(1, 0, dtype=torch.long))[0])
    assert [item for _, item in first] == ["front-left"]
    assert oracle.value.item() > value_of(person, start, silence, 6) + 5


@pytest.mark.parametrize("gain", [0.0, 1e-8])
def test_silence_wins_ties(horizon, monkeypatch, gain):
    """What costs nothing (or earns next to nothing) is not said to a person who does not care."""
    horizon(4)
    monkeypatch.setattr(Channels, "cost", lambda self, flags: -gain * flags.sum(-1).float())
    assert said(Oracle(driver(consistency=0.0), FEW), 3, 4) == 0
    # With more to gain than a tie, it would speak.
    monkeypatch.setattr(Channels, "cost", lambda self, flags: -1e-3 * flags.sum(-1).float())
    assert said(Oracle(driver(consistency=0.0), FEW), 3, 4) > 0


# --- what is merged ---------------------------------------------------------------------------


def random_round(generator, number, steps):
    """Rounds ``[1, R]``: observations, messages and how far their drivers see, at every step."""
    state = DOMAIN.initial(number, generator)
    bins = torch.tensor(DOMAIN.reach_bins)
    reach = bins[torch.randint(len(bins), (number, 4), generator=generator)]
    observations, told = [], []
    for _ in range(steps):
        observation = DOMAIN.observe(state)
        may = DOMAIN.communicable(observation)
        observations.append(observation)
        told.append(
            {
                name: mask & (torch.rand(mask.shape, generator=generator) < 0.15)
                for name, mask in may.items()
            }
        )
        state = DOMAIN.transition(state, torch.randint(2, (number,), generator=generator))
    return reach, observations, told


@pytest.mark.parametrize("planning", [False, True])
def test_the_canonical_form_changes_no_behaviour(generator, planning):
    """Continued from either form, everybody acts the same ever after."""
    number, steps = (20, 8) if planning else (300, 12)
    reach, observations, told = random_round(generator, number, steps)
    people = TaskDrivers(reach, torch.full((number,), 3.0))
    if planning:
        people = replace(
            simulated_drivers("fog", "paper", 1, 0), reach=reach, consistency=people.consistency
        )
    exact = people.start()
    forms, merged = {}, 0
    for step in range(steps):
        probability, exact = people.step(exact, observations[step], told[step])
        for begun, memory in forms.items():
            again, forms[begun] = people.step(memory, observations[step], told[step])
            assert torch.equal(again, probability)
            assert torch.equal(forms[begun].canonical().rows(), exact.canonical().rows())
        # One that was made canonical at this step, and one that is at each.
        forms["each"] = forms.get("each", exact).canonical()
        forms[step] = exact.canonical()
        merged += int((exact.canonical().rows() != exact.rows()).any(-1).sum())
    assert merged > number  # it does change memories


def knowledge(**changes):
    """A person who knows three cars: one by two sights, one by one sight, one by speech."""
    given = {
        "known": [True, True, True, False],
        "position": [3.0, -2.0, 4.0, 0.0],
        "speed": [-1.0, 1.0, 1.0, 0.0],
        "assumed": [False, True, False, False],
        "age": [2.0, 1.0, 0.0, 0.0],
    }
    for name, (index, value) in changes.items():
        given[name][index] = value
    return Memory(**{name: torch.tensor(value) for name, value in given.items()})


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("known", 0, False),
        ("known", 3, True),
        ("position", 1, -3.0),
        ("speed", 2, -1.0),
        ("assumed", 0, True),
        ("assumed", 1, False),
        ("age", 1, 2.0),
    ],
)
def test_rows_differ_where_knowledge_does(name, index, value):
    changed = knowledge(**{name: (index, value)})
    assert not torch.equal(changed.canonical().rows(), knowledge().canonical().rows())


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("position", 3, 7.0),
        ("speed", 3, 1.0),
        ("assumed", 3, True),
        ("age", 3, 5.0),
        ("age", 0, 9.0),
        ("age", 2, 1.0),
    ],
)
def test_rows_are_equal_where_only_what_means_nothing_differs(name, index, value):
    changed = knowledge(**{name: (index, value)})
    assert not torch.equal(changed.rows(), knowledge().rows())
    assert torch.equal(changed.canonical().rows(), knowledge().canonical().rows())


def test_rows_are_equal_exactly_where_every_part_is(generator):
    reach, observations, told = random_round(generator, 150, 5)
    memory = Memory.empty((150,))
    for observation, message in zip(observations, told, strict=True):
        place, lane = observation["visual"][..., 0], observation["ego"][..., 0].long()
        seen = in_sight(reach, place, lane)
        memory = remember(memory, observation, seen, message, reach).canonical()
    rows = memory.rows()
    assert rows.shape == (150, 5 * len(CARS)) and rows.dtype == torch.long
    same = (rows[:, None] == rows).all(-1)
    parts = torch.stack([getattr(memory, field.name).float() for field in fields(Memory)], -1)
    assert torch.equal(same, (parts[:, None] == parts).all((-1, -2)))
    assert same.sum() > 150  # some are equal without being the same

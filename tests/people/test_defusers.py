"""People who defuse bombs: what they know, when they press, and how they are learned."""

from dataclasses import replace

import pytest
import torch

from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.bomb_defusal import BombDefusal, BombState
from mirror_ppl.domains.bomb_defusal.participants import (
    learn_notices,
    participants,
    simulated_defusers,
)
from mirror_ppl.domains.bomb_defusal.people import SimulatedDefusers
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.evaluation.reachable_oracle import ReachableOracle
from mirror_ppl.people import populations_of, simulate, simulated_people
from mirror_ppl.people.recordings import draw_starts, record

WORLD = BombDefusal()
WAIT, RED, GREEN, BLUE, YELLOW = range(5)
NOTHING = {"visual": (), "verbal": False}


def person(notices=0.1, reads=False):
    return SimulatedDefusers(torch.full((1, 6), notices), torch.tensor([reads]))


def bomb(kind=0, symbol=0):
    """One round of one person: terminal 2 is lit at each stage, all show the same symbol."""
    nothing = torch.zeros(1, 1, dtype=torch.long)
    return BombState(
        nothing,
        nothing,
        nothing + kind,
        torch.full((1, 1, 3), 1),
        torch.full((1, 1, 3, 6), symbol),
    )


def tell(terminals=(), kind=False):
    return {
        "visual": torch.tensor([[[k + 1 in terminals for k in range(6)]]]),
        "verbal": torch.tensor([[[kind]]]),
    }


def choices(someone, state, *told, mind_noise=0.9, guess=0.0):
    """What a person does at each step, who is unlucky and first takes the bomb for Type A."""
    mind_noises = torch.full((1, 1, SimulatedDefusers.mind_noises), mind_noise)
    mind_noises[..., 0] = guess
    memory, done = someone.start(1, mind_noise=mind_noises), []
    for message in told:
        probability, memory = someone.step(memory, WORLD.observe(state), message)
        assert float(probability.max()) == 1
        action = probability.argmax(-1)
        done.append(int(action))
        state = WORLD.transition(state, action)
    return done


def test_people_who_find_nothing_wait_and_people_who_are_shown_it_press():
    someone = person()
    assert choices(someone, bomb(), *[None] * 4) == [WAIT] * 4
    assert choices(someone, bomb(), None, tell([1, 3]), tell([2]), None) == [WAIT, WAIT, RED, WAIT]
    # What was found counts until the press, and not at the next stage.
    assert choices(someone, bomb(), tell([2]), tell([2]), tell([2])) == [RED] * 3
    # Noise finds it.
    assert choices(someone, bomb(), None, None, mind_noise=0.05) == [RED, RED]


def test_the_type_is_a_guess_until_it_is_communicated():
    someone = person()
    for guess, pressed in ((0.2, RED), (0.8, YELLOW)):
        assert choices(someone, bomb(0), tell([2]), tell([2]), guess=guess) == [pressed] * 2
    # Told, at any step, they know it for good; wrong presses teach nothing.
    assert choices(someone, bomb(1), tell([2]), tell([2], kind=True), tell([2])) == [
        RED,
        YELLOW,
        YELLOW,
    ]
    assert choices(person(reads=True), bomb(1), tell([2]), tell([2])) == [YELLOW, YELLOW]


def test_buttons_are_those_of_the_rules_that_are_so():
    for kind, row in enumerate(WORLD.rules):
        for symbol, button in enumerate(row):
            told = tell([2], kind=True)
            assert choices(person(), bomb(kind, symbol), told) == [1 + button]


def test_finding_takes_as_long_as_a_geometric_variable(seed):
    """400 people with one round each: steps until the press at the first stage have mean 1 / p.

    The mean is within 4.5 standard errors, but one in 150,000 times; the horizon cuts off
    0.9 ** 60 = 0.002 of them.
    """
    people = SimulatedDefusers(torch.full((400, 6), 0.1), torch.ones(400, dtype=torch.bool))
    start = draw_starts(400, 1, seed, "test", domain=WORLD, mind_noises=people.mind_noises)
    recording = record(people, start)
    first = (recording.actions != WAIT).long().argmax(-1).double() + 1
    error = first.std() / 20
    assert abs(first.mean() - 10) < 4.5 * error + 0.1
    # Nobody who reads the type presses a wrong button.
    assert float(recording.rewards.max()) == 4 and float(recording.rewards.min()) == -1


@pytest.mark.parametrize("told", [0.0, 0.05])
def test_predictions_are_the_frequencies_of_what_people_do(seed, told):
    """Scores of predictions are their entropies on average, if and only if they are right."""
    for reads in (True, False):
        people = SimulatedDefusers(
            torch.linspace(0.04, 0.3, 6).expand(30, 6), torch.full((30,), reads)
        )
        start = draw_starts(
            30, 20, seed, "test", str(reads), domain=WORLD, mind_noises=people.mind_noises
        )
        message_noise = torch.rand(30, 20, 60, 7, generator=torch.Generator().manual_seed(seed))
        recording = record(people, replace(start, message_noise=message_noise), told=told)
        probabilities = people.predictive(
            recording.probabilities, recording.observation, recording.actions, recording.told
        )
        torch.testing.assert_close(probabilities.sum(-1), torch.ones_like(probabilities[..., 0]))
        chosen = probabilities.gather(-1, recording.actions[..., None]).squeeze(-1)
        assert float(chosen.min()) > 0
        excess = (
            (-chosen.log() - torch.special.entr(probabilities).sum(-1)).sum(-1).flatten().double()
        )
        assert abs(excess.mean()) < 4.5 * excess.std() / len(excess) ** 0.5


def test_predictions_by_hand():
    people = person(0.1)
    state, observations = bomb(0, 0), []
    actions = [WAIT, YELLOW, WAIT, WAIT]  # took it for Type B
    for action in [*actions, WAIT]:
        observations.append(WORLD.observe(state))
        state = WORLD.transition(state, torch.tensor([[action]]))
    observation = {name: torch.stack([o[name] for o in observations], 2) for name in ("ego",)} | {
        name: torch.stack([o[name] for o in observations], 2) for name in ("visual", "verbal")
    }
    told = {"visual": torch.zeros(1, 1, 4, 6).bool(), "verbal": torch.zeros(1, 1, 4, 1).bool()}

    def check(*expected):
        found = people.predictive(None, observation, torch.tensor([[actions]]), told)
        for step, probabilities in enumerate(expected):
            assert found[0, 0, step].tolist() == pytest.approx(probabilities)

    half = [0.9, 0.05, 0.0, 0.0, 0.05]
    sure = [0.9, 0.0, 0.0, 0.0, 0.1]
    check(half, half, sure, sure)
    # Who is told that it is Type A knows it from then on, whatever they took it for.
    told["verbal"][0, 0, 2] = True
    right = [0.9, 0.1, 0.0, 0.0, 0.0]
    check(half, half, right, right)
    # Who is shown the lit terminal presses at once.
    told["visual"][0, 0, 3] = WORLD.sought({n: v[0, 0, 3] for n, v in observation.items()})
    check(half, half, right, [0.0, 1.0, 0.0, 0.0, 0.0])


def test_branches_are_all_that_chance_may_decide():
    someone = person(0.1)
    memory = someone.start(1)
    observation = WORLD.observe(bomb(1))
    nobody = tell()
    probabilities, minds, actions = someone.branches(memory, observation, nobody)
    assert probabilities[0, 0].tolist() == pytest.approx([0.45, 0.45, 0.05, 0.05])
    assert actions[0, 0].argmax(-1).tolist() == [WAIT, WAIT, RED, YELLOW]
    # From one of these minds the guess is made, and only the search goes on.
    second = map_state(lambda part: part[:, :, 1], minds)
    probabilities, _, _ = someone.branches(second, observation, nobody)
    assert probabilities[0, 0].tolist() == pytest.approx([0, 0.9, 0, 0.1])
    # Told everything nothing is left to chance but what they would have guessed.
    probabilities, _, actions = someone.branches(memory, observation, tell([2], kind=True))
    assert probabilities[0, 0].tolist() == [0, 0, 0.5, 0.5]
    assert actions[0, 0].argmax(-1).tolist() == [WAIT, WAIT, YELLOW, YELLOW]
    assert someone.kept(memory).mind_noise.shape == (1, 1, 0)


def test_an_oracle_communicates_what_gains():
    """Shown the lit terminal at each stage (0.3) and told the type at the first (0.5): 10.6."""
    state = bomb(1, 2)
    oracle = ReachableOracle(person(0.05), map_state(lambda part: part[0], state))
    assert oracle.value.tolist() == pytest.approx([12 - 3 * 0.3 - 0.5], abs=1e-4)


def test_the_mean_of_noticing_is_learned_from_rounds(seed):
    """Log means from 36 rounds are within 4.5 standard errors, 1 / sqrt(times found) each."""
    truth = participants(20, seed)
    start = draw_starts(20, 36, seed, "test", domain=WORLD, mind_noises=truth.mind_noises)
    recording = record(truth, start)
    found = (recording.actions != WAIT).sum((1, 2)).double()
    error = (learn_notices(recording)[:, 0] / truth.notices[:, 0]).log().double().abs()
    assert (error < 4.5 / found.sqrt()).all()
    own = learn_notices(recording, by_place=True)
    assert own.shape == (20, 6) and (own[:, 0] != own[:, 1]).any()
    assert len(set(participants(5, seed).notices[0].tolist())) == 1
    assert len(set(participants(5, seed, by_place=True).notices[0].tolist())) == 6


@pytest.mark.parametrize("population", populations_of("bomb_defusal"))
def test_the_same_seed_gives_the_same_people_in_every_setting(population):
    one, other = (simulated_defusers(setting, population, 3, 1) for setting in WORLD.settings)
    assert torch.equal(one.notices, other.notices)
    assert one.reads.all() and not other.reads.any()
    again = simulated_people("bomb_defusal", "labelled", population, 3, 1)
    assert torch.equal(again.notices, one.notices)


def test_recordings_are_handed_out_with_the_truth():
    recorded = simulate("bomb_defusal", people=2, rounds=3)
    assert recorded.setting == "unlabelled" and recorded.actions.shape == (2, 3, 60)
    names = [f"notices_terminal {number}" for number in range(1, 7)]
    assert sorted(recorded.truth) == names
    ends = recorded.ego[:, :, :, 0].nan_to_num().amax(-1) == 3
    assert (recorded.lengths[~ends] == 60).all() and (recorded.lengths[ends] <= 60).all()
    with pytest.raises(UnknownNameError, match="labelled, unlabelled"):
        simulate("bomb_defusal", "fog", people=1, rounds=1)
    with pytest.raises(UnknownNameError, match="known: diverse, paper"):
        simulate("bomb_defusal", population="others", people=1, rounds=1)

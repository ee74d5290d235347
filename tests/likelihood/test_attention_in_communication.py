"""What differs from round to round: found out by who communicates with a person."""

import torch
from example_attention import NOTICED, NOTICES, STEPS, OneItem, by_hand, drawn, example, geometric

from mirror_ppl.communication import (
    Communicator,
    ExpectedUtility,
    Person,
    PlanningContext,
    RoundSoFar,
)
from mirror_ppl.communication.rollouts import SelfModelWorld
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.models import HumanModel


def past_of(recordings, time):
    observation, _, actions, _ = vars(rounds_of(recordings, 0).at(0, 1)).values()
    whole = recordings.observation()
    return RoundSoFar(
        {name: value[0, 0, : time + 1] for name, value in whole.items()},
        actions[0, :time],
        {name: torch.zeros(time, 4, dtype=torch.bool) for name in observation if name != "ego"},
    )


def test_who_acts_as_if_they_saw_has_noticed(self_model, recordings):
    """Weights of attention are likelihoods of what was done so far."""
    human = OneItem(self_model)
    draws = drawn(human, 300) | {NOTICES[0]: torch.full((300, 1, 1), 0.3)}
    draws["consistency"], draws["lapse"] = draws["lapse"] * 0 + 4, draws["lapse"] * 0 + 0.02
    for site in ("residual_in", "residual_out"):
        draws[site] = draws[site] * 0
    someone = Person(human, draws)
    assert someone.percept_count == 1
    for time in (0, 9):
        past = past_of(recordings, time)
        there = someone.in_round(past)
        when = there.percepts[NOTICED[0]][there.percept]
        log_weights = geometric(0.3).log()
        if time:
            each = by_hand(human, {n: v[0] for n, v in draws.items()}, recordings, 0, 0)
            log_weights = log_weights + each[:, torch.arange(time), past.actions].sum(-1)
        expected = torch.softmax(log_weights, 0)
        found = torch.bincount(when, minlength=STEPS + 1) / 300
        error = 5 * (expected * (1 - expected) / 300).sqrt() + 1e-3
        assert ((found - expected).abs() < error).all()
        assert there.in_round(past).percepts.keys() == there.percepts.keys()
        again, other = (someone.in_round(past, seed) for seed in (0, 1))
        assert torch.equal(again.percept, there.percept)
        assert not torch.equal(other.percept, there.percept)
    assert someone.percept_count == 1  # untouched
    bare = HumanModel(self_model)
    unchanged = Person(bare, drawn(bare, 2))
    assert unchanged.in_round(past_of(recordings, 3)) is unchanged


def test_rare_attention_is_found_out(self_model, recordings):
    """A person who is hardly ever away does what only a person who is away would do."""
    human = example(self_model)
    draws = drawn(human, 200)
    draws |= {"distracted": torch.full((200, 1, 1), 0.02)}
    for site in ("sight_front_own", "sight_front_other", "sight_back_own", "sight_back_other"):
        draws[site] = torch.full((200, 1, 1), 6)
    draws["consistency"], draws["lapse"] = draws["lapse"] * 0 + 5, draws["lapse"] * 0 + 0.001
    for site in ("residual_in", "residual_out"):
        draws[site] = draws[site] * 0
    someone, told = Person(human, draws), 0
    for number in range(10):
        past = past_of(recordings.select_rounds([number]), 12)
        there = someone.in_round(past)
        away = (there.percepts["away"][there.percept] == 1).double().mean()
        values = torch.tensor([0.0, 1.0])
        alike = {n: value[:1] for n, value in draws.items()}
        log_probabilities = Person(human, alike)._log_probabilities({"away": values}, past)[0]
        expected = torch.softmax(log_probabilities + torch.tensor([0.98, 0.02]).log(), 0)[1]
        # Assumptions differ between draws, the first of which is held against all.
        if expected > 0.9:
            told += 1
            assert away > 0.5
    assert told > 0


def test_a_communicator_plans_for_a_person_who_attends(per_item, recordings):
    someone = Person(per_item, drawn(per_item, 8))
    communicator = Communicator(someone, ExpectedUtility(SelfModelWorld(per_item.self_model), 3))
    for time in (0, 5):
        past = past_of(recordings, time)
        assert communicator.plan(past).message == communicator.plan(past).message
        context = PlanningContext.of(someone, past)
        assert context.person.percept_count > someone.percept_count

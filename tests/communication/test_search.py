"""Search, against values set by hand: the planted best is found, and what is found is valued."""

import pytest
import torch

from mirror_ppl.communication import (
    Automatic,
    CrossEntropy,
    Exhaustive,
    Patient,
    Valued,
    every_message,
    search,
)
from mirror_ppl.communication.communicator import choose
from mirror_ppl.communication.messages import count_messages
from mirror_ppl.communication.search import CHUNK, in_chunks, joined
from mirror_ppl.cross_entropy import CrossEntropyOptions

NUMBER = 8
ALL = torch.ones(NUMBER, dtype=torch.bool)


def only(*places):
    """Flags of some items."""
    allowed = torch.zeros(NUMBER, dtype=torch.bool)
    allowed[list(places)] = True
    return allowed


def steps_of(candidate):
    """The items of each step as sets, without the silence at the end."""
    steps = [frozenset(message.nonzero().squeeze(-1).tolist()) for message in candidate]
    while steps and not steps[-1]:
        steps.pop()
    return tuple(steps)


def plan(*steps):
    """As :func:`steps_of` gives it."""
    return tuple(frozenset(step) for step in steps)


class HandSet:
    """Worth of plans by a function of :func:`steps_of`, the same for three draws.

    Probabilities of actions are the number of items in all, so that rows can be told apart.
    """

    def __init__(self, worth, actions=True):
        self.worth, self.actions = worth, actions
        self.asked = []

    def __call__(self, candidates):
        self.asked.append(len(candidates))
        utility = torch.tensor([float(self.worth(steps_of(each))) for each in candidates])
        actions = candidates.flatten(1).sum(1).float()[:, None, None] if self.actions else None
        return Valued(utility[:, None].expand(-1, 3), actions)


def check(found, value, allowed):
    """What is found starts with silence, keeps to what is allowed, and has the right values."""
    assert found.candidates.dtype == torch.bool
    assert steps_of(found.candidates[0]) == ()
    assert not found.candidates[..., ~allowed].any()
    again = value(found.candidates)
    assert torch.equal(found.valued.utility, again.utility)
    assert torch.equal(found.valued.actions, again.actions)


def best_of(found):
    return steps_of(found.candidates[choose(found.valued, 0.0)])


def table(generator):
    """A random worth for each message; plans of several steps are worth nothing."""
    worth = torch.randn(2**NUMBER, generator=generator).tolist()
    worth[0] = 0.0
    return lambda steps: worth[sum(2**item for item in steps[0])] if len(steps) == 1 else 0.0


# --- every message ----------------------------------------------------------------------------


@pytest.mark.parametrize("places", [(), (5,), (0, 3, 6), tuple(range(NUMBER))])
def test_exhaustive_values_every_message_once(generator, places):
    value, allowed = HandSet(table(generator)), only(*places)
    found = Exhaustive()(value, allowed, 0)
    assert found.candidates.shape == (2 ** len(places), 1, NUMBER)
    assert torch.equal(found.candidates[:, 0], every_message(allowed))
    assert value.asked == [2 ** len(places)]
    check(found, value, allowed)


@pytest.mark.parametrize("most", [1, 2, 3, 9])
def test_messages_can_be_of_few_items_only(generator, most):
    """They are those of all messages that are as small, in another order."""
    allowed = only(0, 2, 3, 6)
    few, every = every_message(allowed, most), every_message(allowed)
    assert not few[0].any()
    small = every[every.sum(-1) <= most]
    assert {tuple(row) for row in few.tolist()} == {tuple(row) for row in small.tolist()}
    assert len(few) == len(small) == count_messages(allowed, most)
    assert count_messages(allowed) == 16
    value = HandSet(table(generator))
    found = Automatic(steps=2, items=most)(value, allowed, 0)
    assert found.candidates.sum(-1).max() <= most
    assert value.asked[0] == len(small)
    # So few that they need not be searched.
    big = torch.ones(NUMBER, dtype=torch.bool)
    found = Automatic(steps=1, most=1 + NUMBER, items=1)(HandSet(table(generator)), big, 0)
    assert len(found.candidates) == 1 + NUMBER


@pytest.mark.parametrize("best", [{3}, {0, 7}, {1, 2, 4, 5}, set(range(NUMBER))])
def test_exhaustive_finds_the_planted_best(best):
    """Which no search that goes from good to better would find: parts of it are worth nothing."""
    value = HandSet(lambda steps: float(steps == plan(best)) - 0.1 * (steps != ()))
    assert best_of(Exhaustive()(value, ALL, 0)) == plan(best)
    # Where it may not be said, silence is best.
    assert best_of(Exhaustive()(value, ALL & ~only(min(best)), 0)) == ()


# --- plans ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("now", "next_", "then", "best"),
    [
        (5, 4, 3, plan({2})),
        (5, 6, 4, plan({}, {2})),
        (5, 6, 7, plan({}, {}, {2})),
        (5, 5, 5, plan({2})),  # of equally good ones the first is taken
        (-1, 6, 7, ()),  # what is worth nothing now is not looked at
    ],
)
def test_waiting_is_preferred_where_it_is_better(now, next_, then, best):
    worth = {plan({2}): now, plan({}, {2}): next_, plan({}, {}, {2}): then}
    value, allowed = HandSet(lambda steps: worth.get(steps, -1.0 if steps else 0.0)), only(2, 3, 7)
    found = Patient(3)(value, allowed, 0)
    check(found, value, allowed)
    assert best_of(found) == best
    # Without patience it is said as soon as it helps.
    assert best_of(Patient(1)(value, allowed, 0)) == (plan({2}) if now > 0 else ())


@pytest.mark.parametrize(
    ("late", "best"),
    [
        (0.5, {plan({1}, {4})}),  # said one by one they cost 2, together 4
        (2.5, {plan({1, 4})}),  # it is worth that to know both now
    ],
)
def test_messages_are_split_where_that_is_cheaper(late, best):
    """Only both items help; the second one may come a step late, at a price, and not the first."""

    def worth(steps):
        told = {item: step for step, items in reversed([*enumerate(steps)]) for item in items}
        helps = told.get(1) == 0 and 4 in told
        return 10 * helps - late * told.get(4, 0) - sum(len(items) ** 2 for items in steps)

    value, allowed = HandSet(worth), only(1, 4, 6)
    found = Patient(2)(value, allowed, 0)
    check(found, value, allowed)
    assert {best_of(found)} == best


def test_plans_are_made_of_the_best_messages_only():
    worth = {plan({0}): 1, plan({1}): 3, plan({0, 1}): 2, plan({2}): -1}
    value = HandSet(lambda steps: worth.get(steps, 0.0))
    found = Patient(3, best=2)(value, only(0, 1, 2), 0)
    check(found, value, only(0, 1, 2))
    plans = [steps_of(each) for each in found.candidates]
    assert len(set(plans)) == len(plans)
    assert plans[8:] == [
        plan({}, {1}),
        plan({}, {}, {1}),
        plan({}, {0, 1}),
        plan({}, {}, {0, 1}),
        plan({0}, {1}),
        plan({1}, {0}),
    ]
    assert value.asked[:2] == [8, 6]
    # One more: message 0 later.
    more = Patient(3, best=3)(value, only(0, 1, 2), 0)
    assert [steps_of(each) for each in more.candidates[14:]] == [plan({}, {0}), plan({}, {}, {0})]


def test_without_a_message_that_helps_there_are_no_plans():
    value = HandSet(lambda steps: -len(steps))
    found = Patient(3)(value, only(0, 1, 2), 0)
    assert found.candidates.shape == (8, 1, NUMBER)
    assert best_of(found) == ()
    assert value.asked == [8]


def test_of_few_messages_all_plans_are_valued_at_once():
    value = HandSet(lambda steps: -len(steps))
    found = Patient(3)(value, only(0, 1), 0)
    assert {str(steps_of(each)) for each in found.candidates} == {
        str(one)
        for one in (
            plan(),
            *(plan(*({} for _ in range(delay)), who) for delay in range(3) for who in ({0}, {1})),
            *(plan(*({} for _ in range(delay)), {0, 1}) for delay in range(3)),
            plan({0}, {1}),
            plan({1}, {0}),
        )
    }
    assert best_of(found) == ()
    assert value.asked == [12]


@pytest.mark.parametrize("search_", [Patient, CrossEntropy])
def test_plans_have_at_least_one_step(search_):
    with pytest.raises(ValueError) as error:
        search_(0)
    assert str(error.value) == "steps must be at least 1, not 0"


# --- the cross-entropy method -----------------------------------------------------------------


def nearness(planted):
    """Worth falls with the number of items in which a plan differs from the planted one."""

    def worth(steps):
        length = max(len(steps), len(planted))
        padded = [[*each, *[frozenset()] * (length - len(each))] for each in (steps, planted)]
        return -sum(len(mine ^ theirs) for mine, theirs in zip(*padded, strict=True))

    return worth


@pytest.mark.parametrize("best", [set(), {6}, {0, 1}, {2, 4, 7}, {0, 1, 2, 3, 4}, set(range(8))])
def test_the_cross_entropy_method_finds_what_exhaustive_search_finds(seed, best):
    value = HandSet(nearness(plan(best) if best else ()))
    found = CrossEntropy(1)(value, ALL, seed)
    check(found, value, ALL)
    assert best_of(found) == best_of(Exhaustive()(value, ALL, 0)) == (plan(best) if best else ())


@pytest.mark.parametrize(
    "best",
    [
        plan({3}),
        plan({}, {5}),
        plan({0}, {1}),
        plan({0, 5}, {2}),
        plan({}, {}, {4, 7}),
        plan({1}, {6}, {2, 3}),
        plan({1, 2}, {}, {0, 4, 5}),
    ],
)
def test_the_cross_entropy_method_finds_the_best_sequence(seed, best):
    """In 3,600 searches for random sequences of one to six items none failed."""
    value = HandSet(nearness(best))
    for steps in {max(2, len(best)), 3}:
        found = CrossEntropy(steps)(value, ALL, seed)
        check(found, value, ALL)
        assert found.candidates.shape[1] == steps
        assert best_of(found) == best


def test_sequences_are_made_of_allowed_items(seed):
    """The best plan has an item that may not be sent; the best of what remains is found."""
    value, allowed = HandSet(nearness(plan({0, 2, 7}, {5}))), only(2, 4, 5, 7)
    found = CrossEntropy(2)(value, allowed, seed)
    check(found, value, allowed)
    assert best_of(found) == plan({2, 7}, {5})


def test_the_best_sequence_comes_with_its_variations(seed):
    best = plan({0, 5}, {2})
    found = CrossEntropy(2)(HandSet(nearness(best)), ALL, seed)
    plans = [steps_of(each) for each in found.candidates]
    assert plans[:3] == [(), best, plan({0, 5})]
    assert set(plans[3:]) == {plan({5}, {2}), plan({0}, {2}), plan({0, 5})}
    assert len(plans) == 6


def test_the_same_seed_finds_the_same():
    def worth(steps):
        return sum(((3 * item + 5 * step) % 7 - 2.5) for step, s in enumerate(steps) for item in s)

    weak = CrossEntropyOptions(samples=8, elites=2, iterations=2)
    found = [CrossEntropy(3, weak)(HandSet(worth), ALL, seed) for seed in (0, 0, 1)]
    assert torch.equal(found[0].candidates, found[1].candidates)
    assert torch.equal(found[0].valued.utility, found[1].valued.utility)
    assert not torch.equal(found[0].candidates[1], found[2].candidates[1])


# --- which search -----------------------------------------------------------------------------


@pytest.mark.parametrize(("items", "most"), [(3, 8), (3, 9), (2, 7), (0, 1)])
def test_few_messages_are_valued_one_by_one(items, most):
    value, allowed = HandSet(nearness(plan({0, 1}))), only(*range(items))
    found = Automatic(2, most)(value, allowed, 3)
    patient = Patient(2)(value, allowed, 3)
    assert torch.equal(found.candidates, patient.candidates)
    assert torch.equal(found.valued.utility, patient.valued.utility)


@pytest.mark.parametrize(("items", "most"), [(3, 7), (4, 8), (8, 255), (1, 1)])
def test_beyond_the_limit_messages_are_searched_for(items, most):
    value, allowed = HandSet(nearness(plan({0, 1}, {2}))), only(*range(items))
    found = Automatic(2, most)(value, allowed, 3)
    other = CrossEntropy(2)(value, allowed, 3)
    assert torch.equal(found.candidates, other.candidates)
    assert torch.equal(found.valued.utility, other.valued.utility)
    assert not torch.equal(Patient(2)(value, allowed, 3).candidates, found.candidates)


def test_by_default_4096_messages_are_valued_one_by_one():
    asked = []

    def value(candidates):
        asked.append(len(candidates))
        return Valued(-candidates.flatten(1).sum(1, keepdim=True).float(), None)

    assert len(Automatic()(value, torch.ones(12, dtype=torch.bool), 0).candidates) == 4096
    assert asked == [CHUNK] * 8
    assert len(Automatic()(value, torch.ones(13, dtype=torch.bool), 0).candidates) < 100


# --- chunks -----------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [1, CHUNK, CHUNK + 1, 3 * CHUNK - 7])
@pytest.mark.parametrize("with_actions", [False, True])
def test_many_candidates_are_valued_in_chunks_as_in_one_go(generator, number, with_actions):
    candidates = torch.rand(number, 2, NUMBER, generator=generator) < 0.5
    weights = torch.randn(2 * NUMBER, 5, generator=generator)
    asked = []

    def value(part):
        asked.append(len(part))
        utility = part.flatten(1).float() @ weights
        return Valued(utility, utility[:, :4].view(-1, 2, 2) if with_actions else None)

    valued = in_chunks(value, candidates)
    assert max(asked) <= CHUNK and sum(asked) == number
    whole = value(candidates)
    torch.testing.assert_close(valued.utility, whole.utility)
    if with_actions:
        torch.testing.assert_close(valued.actions, whole.actions)
    else:
        assert valued.actions is None


@pytest.mark.parametrize("search_", [Exhaustive(), Patient(2), CrossEntropy(2)])
def test_searches_find_the_same_in_chunks(monkeypatch, seed, search_):
    value = HandSet(nearness(plan({1, 4}, {2})))
    whole = search_(value, ALL, seed)
    monkeypatch.setattr(search, "CHUNK", 3)
    value.asked.clear()
    parts = search_(value, ALL, seed)
    assert max(value.asked) <= 3
    assert torch.equal(whole.candidates, parts.candidates)
    assert torch.equal(whole.valued.utility, parts.valued.utility)
    assert torch.equal(whole.valued.actions, parts.valued.actions)


@pytest.mark.parametrize("search_", [Patient(2), CrossEntropy(2)])
def test_objectives_need_not_look_at_actions(search_):
    value = HandSet(nearness(plan({1}, {2})), actions=False)
    assert search_(value, ALL, 0).valued.actions is None


def test_only_what_is_new_is_valued_and_each_index_is_returned(generator):
    value, allowed = HandSet(table(generator)), only(0, 3)
    found = Exhaustive()(value, allowed, 0)
    both, other = only(0, 3)[None], only(5)[None]
    more = torch.stack([both, other, found.candidates[0], only(6)[None], other])
    value.asked.clear()
    longer, place = joined(found, more, value)
    assert value.asked == [2]
    assert len(longer.candidates) == len(found.candidates) + 2
    assert torch.equal(longer.candidates[: len(found.candidates)], found.candidates)
    assert torch.equal(longer.candidates[place], more)
    check(longer, value, only(0, 3, 5, 6))
    same, place = joined(found, found.candidates[[2, 1]], value)
    assert same is found
    assert place.tolist() == [2, 1]

"""People who search and rescue: what they know, where they go, what is learned of them."""

import math
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import one_hot

from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.search_rescue import RescueState, SearchRescue
from mirror_ppl.domains.search_rescue.house import CORRIDORS, ENTRANCE, ROOMS
from mirror_ppl.domains.search_rescue.participants import (
    RADII,
    learn_transitions,
    learned_transitions,
    participants,
    transitions_of,
)
from mirror_ppl.domains.search_rescue.people import (
    HOME,
    SUBGOALS,
    SimulatedFirefighters,
    possible_subgoals,
    subgoal_distances,
)
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.people import act, people_of, record, simulate, simulated_people
from mirror_ppl.people.recordings import draw_starts

WORLD = SearchRescue()
LEFT, RIGHT, TOP_LEFT, TOP_MIDDLE, TOP_RIGHT, ENTRY = range(6)
ALL = 7
"""The victim may be in every room."""
UP, DOWN, WEST, EAST = range(4)


def person(radius=1.5, lapse=0.0, transitions=None):
    """One firefighter; of equal habits unless said otherwise."""
    equal = torch.ones(1, 8, 6, 6) if transitions is None else transitions
    return SimulatedFirefighters(torch.tensor([radius]), equal, torch.tensor([lapse]))


def state(place, blocked=0, victim=0, found=False):
    """One round ``[1, 1]`` at a place."""
    return RescueState(
        torch.tensor([[place]]),
        torch.tensor([[found]]),
        torch.tensor([[False]]),
        torch.tensor([[blocked]]),
        torch.tensor([[victim]]),
    )


def looking(someone, place, memory=None, told=None, **what):
    """Probabilities of actions and memory after a look."""
    memory = someone.start(1) if memory is None else memory
    probabilities, memory = someone.step(memory, WORLD.observe(state(place, **what)), told)
    return probabilities[0, 0], memory


def message(**items):
    """Masks ``[1, 1, K]`` of what is told."""
    return {
        m.name: torch.tensor([[[item in items.get(m.name, ()) for item in m.items]]])
        for m in WORLD.modalities
    }


def wanting(goal, memory=None, someone=None):
    memory = (someone or person()).start(1) if memory is None else memory
    return replace(memory, goal=torch.full_like(memory.goal, goal))


# --- shortest ways ----------------------------------------------------------------------------


def test_distances_are_those_of_the_house():
    """Counted by hand: all ways between the halves lead through a corridor."""
    far = subgoal_distances()
    assert torch.equal(far, far.T)
    assert far[ENTRY].tolist() == [7, 7, 10, 13, 10, 0]
    assert far[LEFT].tolist() == [0, 6 + 2 * 2, 3, 6, 9, 7]
    assert far[TOP_LEFT].tolist() == [3, 9, 0, 3, 6, 10]


@pytest.mark.parametrize(
    ("place", "goal", "ways"),
    [
        (ENTRANCE, LEFT, {UP, WEST}),
        (ENTRANCE, RIGHT, {UP, EAST}),
        ((6, 4), LEFT, {WEST}),
        ((6, 1), LEFT, {UP}),
        ((4, 1), TOP_RIGHT, {UP}),
        ((2, 1), TOP_LEFT, {UP}),
        ((2, 3), TOP_RIGHT, {UP, EAST}),
        ((5, 7), ENTRY, {DOWN}),
    ],
)
def test_steps_are_those_of_shortest_ways(place, goal, ways):
    someone = person(lapse=0.2)
    memory = wanting(goal)
    carrying = goal == ENTRY
    room = goal - TOP_LEFT if TOP_LEFT <= goal <= TOP_RIGHT else 1
    probabilities, after = looking(someone, place, memory, found=carrying, victim=room)
    assert int(after.goal) == goal
    expected = [0.05 + 0.8 * (action in ways) / len(ways) for action in range(4)]
    assert probabilities.tolist() == pytest.approx(expected, abs=1e-6)


def test_a_known_obstacle_is_walked_around():
    """At the lower end of the left corridor, which is blocked: back to the hall."""
    probabilities, memory = looking(person(), (5, 1), wanting(LEFT), blocked=1)
    assert int(memory.goal) == RIGHT
    assert probabilities.tolist() == [0.0, 1.0, 0.0, 0.0]
    # Who does not see it goes on.
    probabilities, memory = looking(person(0.5), (5, 1), wanting(LEFT), blocked=1)
    assert int(memory.goal) == LEFT
    assert probabilities.tolist() == [1.0, 0.0, 0.0, 0.0]


# --- what is possible -------------------------------------------------------------------------


def possible(place, memory, **what):
    someone = person()
    observation = WORLD.observe(state(place, **what))
    knowledge = someone._learn(memory, observation, None)
    mask = possible_subgoals(knowledge, observation)[0, 0]
    return {goal for goal in range(6) if mask[goal]}


def test_subgoals_are_those_that_make_sense():
    nothing = person().start(1)
    assert possible(ENTRANCE, nothing) == {LEFT, RIGHT}
    assert possible((5, 1), nothing, blocked=1) == {RIGHT}
    assert possible((5, 7), nothing, blocked=1) == {LEFT, RIGHT}
    assert possible((4, 1), nothing) == {TOP_LEFT, TOP_MIDDLE, TOP_RIGHT}
    # In an empty room, and in the room of the victim.
    assert possible((2, 1), nothing, victim=1) == {TOP_MIDDLE, TOP_RIGHT}
    assert possible((2, 1), nothing, victim=0) == {TOP_LEFT}
    assert possible((1, 1), nothing, victim=0, found=True) == {LEFT, RIGHT}
    assert possible((3, 7), nothing, blocked=2, found=True) == {LEFT}
    assert possible((4, 7), nothing, found=True) == {ENTRY}
    assert possible((7, 7), nothing, found=True) == {ENTRY}


def test_after_two_empty_rooms_the_third_is_certain():
    someone = person()
    _, memory = looking(someone, (2, 1), victim=2)
    _, memory = looking(someone, (2, 4), memory, victim=2)
    assert int(memory.goal) == TOP_RIGHT
    assert memory.rooms.all()


def test_goals_are_kept_until_reached_or_ruled_out():
    someone = person()
    _, memory = looking(someone, (6, 4), wanting(RIGHT))
    assert int(memory.goal) == RIGHT
    _, memory = looking(someone, (5, 7), memory)
    assert int(memory.goal) == RIGHT
    _, memory = looking(someone, (4, 7), memory)
    assert int(memory.goal) in (TOP_LEFT, TOP_MIDDLE, TOP_RIGHT)


# --- what is told -----------------------------------------------------------------------------


def test_people_informed_of_the_victims_room_choose_anew():
    liked = torch.full((1, 8, 6, 6), 1e-9)
    liked[:, ALL, HOME, LEFT] = 1.0  # as long as they know nothing
    liked[:, 4, HOME, RIGHT] = 1.0  # with the victim at the top right
    liked[:, 6, HOME, RIGHT] = 1.0  # or in the middle
    someone = person(transitions=liked)
    _, memory = looking(someone, (7, 3), victim=2)
    assert int(memory.goal) == LEFT
    for told in (message(verbal=["top-right"]), message(visual=["top-right"])):
        _, after = looking(someone, (7, 3), memory, told, victim=2)
        assert int(after.goal) == RIGHT
        # It is news only once.
        later = replace(after, goal=torch.full_like(after.goal, LEFT))
        _, later = looking(someone, (7, 3), later, victim=2)
        assert int(later.goal) == LEFT
    # So do they if all they are told is where it is not, but not of a corridor, or beyond the hall.
    _, after = looking(someone, (7, 3), memory, message(verbal=["top-left"]), victim=2)
    assert int(after.goal) == RIGHT
    _, after = looking(someone, (7, 3), memory, message(verbal=["right corridor"]), victim=2)
    assert int(after.goal) == LEFT
    _, after = looking(someone, (3, 1), wanting(TOP_MIDDLE), message(verbal=["top-left"]), victim=2)
    assert int(after.goal) == TOP_MIDDLE


def test_people_informed_of_an_obstacle_take_the_other_corridor():
    someone = person()
    told = message(verbal=["left corridor"])
    _, memory = looking(someone, (7, 3), wanting(LEFT), told, blocked=1)
    assert int(memory.goal) == RIGHT
    assert memory.corridors.all()


def test_they_see_by_radius_and_hear_nothing():
    someone = SimulatedFirefighters(
        torch.tensor([1.5, 10.0]), torch.ones(2, 8, 6, 6), torch.zeros(2)
    )
    two = map_state(lambda part: part.expand(2, *part.shape[1:]), state((7, 4)))
    seen = someone.sees(WORLD.observe(two))
    assert seen["visual"][0, 0].nonzero().flatten().tolist() == [7]
    assert seen["visual"][1].all()
    assert not seen["verbal"].any()


# --- chance -----------------------------------------------------------------------------------


def test_action_noise_chooses_actions_with_their_probabilities():
    probabilities = torch.tensor([0.1, 0.0, 0.6, 0.3])
    action_noise = (torch.arange(1000) + 0.5) / 1000
    counts = torch.bincount(act(probabilities.expand(1000, 4), action_noise), minlength=4)
    assert counts.tolist() == [100, 0, 600, 300]
    # Of two actions the second is taken where the noise is below its probability.
    two = act(torch.tensor([[0.7, 0.3]] * 2), torch.tensor([0.299, 0.301]))
    assert two.tolist() == [1, 0]


def test_mind_noise_chooses_goals_with_their_probabilities(seed):
    generator = torch.Generator().manual_seed(seed)
    liked = torch.rand(1, 8, 6, 6, generator=generator) + 0.1
    someone, number = person(transitions=liked), 20_000
    mind_noise = torch.rand(1, number, 36, generator=generator)
    observation = WORLD.observe(
        map_state(lambda part: part.expand(1, number, *part.shape[2:]), state((4, 1)))
    )
    memory = replace(
        someone.start(number, mind_noise=mind_noise), goal=torch.full((1, number), LEFT)
    )
    _, after = someone.step(memory, observation)
    shares = one_hot(after.goal[0], 6).float().mean(0)
    expected = liked[0, ALL, LEFT] * torch.tensor([0, 0, 1, 1, 1, 0])
    expected = expected / expected.sum()
    # Five standard errors of a share of 20,000.
    assert (shares - expected).abs().max() < 5 * 0.5 / math.sqrt(number)
    # Without mind_noise the likeliest happens.
    _, after = looking(someone, (4, 1), wanting(LEFT, someone=someone))
    assert int(after.goal) == int(expected.argmax())


def test_branches_are_all_that_a_step_can_lead_to(generator):
    someone = simulated_people("search_rescue", "smoke", "paper", 1, 0)
    start = draw_starts(1, 200, 0, "branches", domain=WORLD, mind_noises=36)
    memory, now = someone.start(200, mind_noise=start.mind_noise), start.state
    told = {m.name: torch.zeros(1, 200, len(m.items), dtype=torch.bool) for m in WORLD.modalities}
    for action_noise in start.action_noise[..., :20].unbind(-1):
        observation = WORLD.observe(now)
        chance, minds, every = someone.branches(memory, observation, told)
        probability, memory = someone.step(memory, observation, told)
        torch.testing.assert_close(chance.sum(-1), torch.ones(1, 200))
        own = memory.goal[..., None]
        assert (chance.gather(-1, own) > 0).all()
        mine = every.gather(-2, own[..., None].expand(-1, -1, 1, 4))[:, :, 0]
        assert torch.equal(mine, probability)
        for name in ("corridors", "rooms"):
            assert torch.equal(getattr(minds, name)[:, :, 0], getattr(memory, name))
        assert minds.goal[0, 0].tolist() == list(range(6))
        now = WORLD.transition(now, act(probability, action_noise))


@pytest.mark.parametrize("told", [0.0, 0.03])
def test_predictions_without_reading_minds_are_right_on_average(seed, told):
    """Surprise by what they do is what the predictive distribution says: its entropy."""
    people = simulated_people("search_rescue", "smoke", "paper", 4, 0)
    start = draw_starts(4, 300, seed, "predictive", domain=WORLD, mind_noises=people.mind_noises)
    items = sum(len(part.items) for part in WORLD.modalities)
    message_noise = torch.rand(
        4, 300, WORLD.horizon, items, generator=torch.Generator().manual_seed(seed)
    )
    recording = record(people, replace(start, message_noise=message_noise), told=told)
    probabilities = people.predictive(
        recording.probabilities, recording.observation, recording.actions, recording.told
    )
    torch.testing.assert_close(probabilities.sum(-1), torch.ones(probabilities.shape[:-1]))
    alive = torch.arange(WORLD.horizon) < recording.lengths[..., None]
    surprise = -probabilities.gather(-1, recording.actions[..., None])[..., 0].log()
    excess = ((surprise - torch.special.entr(probabilities).sum(-1)) * alive).sum(-1).flatten()
    # Differences of a martingale: rounds are independent. 4.5 standard errors, 1 of 150,000 seeds.
    assert excess.mean().abs() < 4.5 * excess.std() / len(excess) ** 0.5
    # Reading their minds predicts better.
    own = -recording.probabilities.gather(-1, recording.actions[..., None])[..., 0].log()
    assert ((surprise - own) * alive).sum(-1).mean() > 0.5


# --- learning from participants ---------------------------------------------------------------


def test_habits_and_patience_are_learned_from_rounds():
    """Shares of first corridors and of rooms, learned from 800 rounds, are within .12."""
    habit = torch.zeros(2, 6, 6)
    habit[0, HOME, LEFT], habit[1, HOME, LEFT] = 1.2, -1.2
    true = transitions_of(habit, torch.tensor([1.5, 4.0]))
    someone = SimulatedFirefighters(torch.tensor([1.5, 1.5]), true, torch.tensor([0.02, 0.02]))
    start = draw_starts(2, 800, 0, "habits", domain=WORLD, mind_noises=36)
    learned = learn_transitions([record(someone, start)])

    def share(weights, rooms, before, first, others):
        own = weights[:, rooms, before]
        return own[:, first] / own[:, others].sum(-1)

    for case in (
        (ALL, HOME, LEFT, [LEFT, RIGHT]),
        (ALL, LEFT, TOP_LEFT, [TOP_LEFT, TOP_MIDDLE, TOP_RIGHT]),
        (6, TOP_LEFT, TOP_MIDDLE, [TOP_MIDDLE, TOP_RIGHT]),
        # Nobody was ever told where the victim is: that follows from what else they do.
        (4, HOME, LEFT, [LEFT, RIGHT]),
    ):
        expected = share(true, *case).tolist()
        assert share(learned, *case).tolist() == pytest.approx(expected, abs=0.12), case


def test_ways_are_as_long_as_a_person_knows():
    """With patience 1 and no habits, the odds of the corridors are e to the steps by which."""
    liked = transitions_of(torch.zeros(1, 6, 6), torch.ones(1))[0].log()
    odds = liked[:, HOME, LEFT] - liked[:, HOME, RIGHT]
    # Top left: 10 against 16 steps; middle: equal; the mean of several rooms.
    assert odds.tolist()[1:] == pytest.approx([6, 0, 3, -6, 0, -3, 0], abs=1e-3)
    # With the victim found at the top left: 3 + 7 steps against 9 + 7.
    assert float(liked[1, TOP_LEFT, LEFT] - liked[1, TOP_LEFT, RIGHT]) == pytest.approx(6, abs=1e-3)


def test_participants_like_short_ways():
    everybody = participants("clear", 200, 0)
    liked = everybody.transitions
    to_left = liked[:, 1, HOME, LEFT] > liked[:, 1, HOME, RIGHT]
    assert to_left.float().mean() > 0.95
    middle = (liked[:, 2, HOME, LEFT] > liked[:, 2, HOME, RIGHT]).float().mean()
    assert 0.35 < middle < 0.65
    assert everybody.lapse.median() == pytest.approx(0.03, rel=0.2)
    assert participants("smoke", 3, 0).radius.tolist() == [1.5] * 3
    assert torch.equal(participants("smoke", 3, 0).transitions, liked[:3])


# --- recordings -------------------------------------------------------------------------------


@pytest.mark.parametrize("setting", WORLD.settings)
def test_recordings_are_rounds_of_the_world(setting):
    data = simulate("search_rescue", setting, people=3, rounds=12)
    assert data.shape == (3, 12, 48) and data.setting == setting
    assert data.truth["sight_radius"].tolist() == [1.5 if setting == "smoke" else 10.0] * 3
    assert (data.lengths < 48).any()
    ends = data.lengths[..., None] == torch.arange(49)
    ego = data.ego[ends]
    home = (ego == torch.tensor([*map(float, ENTRANCE), 1.0])).all(-1)
    assert torch.equal(home, data.lengths.flatten() < 48)
    # Rewards are those of rounds without collisions: 16 less .1 a step.
    returns = data.rewards.nansum(-1).flatten()
    expected = 16 - 0.1 * data.lengths.flatten()
    torch.testing.assert_close(returns[home], expected[home], rtol=0, atol=1e-3)
    assert (data.action_entropy.nan_to_num() <= math.log(4) + 1e-6).all()


def test_the_same_seed_gives_the_same_people_in_every_setting():
    few, many = (simulate("search_rescue", "smoke", people=n, rounds=3) for n in (2, 3))
    assert torch.equal(few.actions, many.actions[:2])
    clear = simulate("search_rescue", "clear", people=2, rounds=3)
    assert torch.equal(clear.truth["lapse"], few.truth["lapse"])
    other = simulate("search_rescue", "smoke", people=2, rounds=3, seed=1)
    assert not torch.equal(other.actions, few.actions)
    torch.testing.assert_close(
        learned_transitions(2, 0), learned_transitions(3, 0)[:2], rtol=0.02, atol=0.01
    )


def test_who_sees_less_needs_longer():
    clear, smoke = (
        simulate("search_rescue", setting).lengths.float().mean() for setting in WORLD.settings
    )
    assert smoke > clear + 1


def test_populations():
    assert people_of("search_rescue").populations == ("paper", "diverse")
    diverse = simulated_people("search_rescue", "clear", "diverse", 40, 0)
    assert set(diverse.radius.tolist()) == set(torch.tensor(RADII).tolist())
    assert set(RADII) <= set(WORLD.reach_bins)
    with pytest.raises(UnknownNameError, match='unknown population "papr"'):
        simulated_people("search_rescue", "clear", "papr", 1, 0)
    with pytest.raises(UnknownNameError, match='unknown setting "fog"'):
        simulated_people("search_rescue", "fog", "paper", 1, 0)


def test_subgoals_are_the_places_of_the_house():
    assert list(SUBGOALS.values()) == [*CORRIDORS.values(), *ROOMS.values(), ENTRANCE]
    assert HOME == ENTRY

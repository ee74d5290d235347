"""Search and rescue: starts, moves, rewards and values, by hand and by search."""

import itertools
import math

import pytest
import torch
from example_rescue import DOWN, LEFT, NINE, RIGHT, UP, WORLD, alone, reachable, start, walk

from mirror_ppl.domains.search_rescue.house import ENTRANCE, HOUSE

TO_LEFT = [LEFT] * 3 + [UP] * 7
"""From the entrance through the left corridor to the room at the top left."""


def test_there_are_nine_scenarios_and_all_begin_at_the_entrance():
    assert len(WORLD.scenarios) == len(set(WORLD.scenarios)) == 9
    state = start(NINE)
    assert state.place.tolist() == [list(ENTRANCE)] * 9
    pairs = set(zip(state.blocked.tolist(), state.victim.tolist(), strict=True))
    assert pairs == set(itertools.product(range(3), range(3)))
    assert not state.found.any() and not state.home.any()
    assert WORLD.scenarios[0] == "victim top-left, no corridor blocked"
    assert WORLD.scenarios[5] == "victim top-right, left corridor blocked"
    assert (state.blocked[5], state.victim[5]) == (1, 2)


def test_the_same_seed_starts_the_same_round():
    for seed in range(3):
        one, other = start(seed=seed, number=50), start(seed=seed, number=50)
        assert torch.equal(one.blocked, other.blocked) and torch.equal(one.victim, other.victim)
    drawn = start(number=9000)
    counts = torch.bincount(drawn.blocked * 3 + drawn.victim, minlength=9)
    assert ((counts - 1000).abs() < 5 * 1000**0.5).all()


def test_the_robot_learns_from_rounds_that_begin_anywhere_and_often_where_rounds_do(generator):
    state = WORLD.anywhere(8000, generator)
    entrance = (state.place == torch.tensor(ENTRANCE)).all(-1)
    begins = entrance & ~state.found
    # A quarter begin there, and of the others one in 60 cells, half of them without the victim.
    share = 0.25 + 0.75 / 60 / 2
    assert abs(begins.float().mean() - share) < 4.5 * (share * (1 - share) / 8000) ** 0.5 + 0.005
    others = state.found[~begins].float()
    assert abs(others.mean() - 0.5) < 0.05
    assert (state.home == (state.found & entrance)).all()
    assert len(set(map(tuple, state.place.tolist()))) == 60


def test_a_rescue_by_hand():
    states, terms = walk(alone(0), TO_LEFT + [DOWN] * 7 + [RIGHT] * 3 + [UP])
    assert states[10].place.tolist() == [1, 1] and states[10].found and not states[9].found
    time = {"time": pytest.approx(-0.1)}
    assert terms[:9] == [time] * 9
    assert terms[9] == {"found": 1.0} | time
    assert terms[10:19] == [time] * 9
    assert terms[19] == {"returned": 15.0} | time
    # Whoever is back stays, and nothing counts any more.
    assert states[20].home and states[21].place.tolist() == list(ENTRANCE)
    assert terms[20] == {}
    total = sum(sum(step.values()) for step in terms)
    assert total == pytest.approx(16 - 2.0)
    values = WORLD.reference_values(alone(0), 1.0)
    assert float(values.max()) == pytest.approx(14.0, abs=1e-4)


def test_an_obstacle_costs_and_stays_in_the_way():
    states, terms = walk(alone(3), [LEFT] * 3 + [UP] * 3 + [UP, UP, DOWN])
    assert states[6].place.tolist() == states[8].place.tolist() == [5, 1]
    assert terms[6] == terms[7] == {"collision": -10.0, "time": pytest.approx(-0.1)}
    assert states[9].place.tolist() == [6, 1] and "collision" not in terms[8]
    # The other corridor is free.
    states, terms = walk(alone(3), [RIGHT] * 3 + [UP] * 7)
    assert states[-1].place.tolist() == [1, 7]
    assert not any("collision" in step for step in terms)


def test_walls_and_the_edge_stop_for_nothing_but_time():
    states, terms = walk(alone(0), [DOWN, UP, UP, UP, UP])
    assert [state.place.tolist() for state in states[1:]] == [[8, 4], [7, 4], [6, 4]] + [[6, 4]] * 2
    assert all(step == {"time": pytest.approx(-0.1)} for step in terms)


def test_one_round_in_a_batch_is_that_round_alone():
    state = start(NINE)
    actions = torch.randint(4, (40, 9), generator=torch.Generator().manual_seed(1))
    single = [alone(scenario) for scenario in range(9)]
    for action in actions:
        following = WORLD.transition(state, action)
        rewards = WORLD.rewards(state, action, following)
        observed = WORLD.observe(following)
        for place in range(9):
            after = WORLD.transition(single[place], action[place])
            own = WORLD.rewards(single[place], action[place], after)
            assert {n: float(v) for n, v in own.items()} == {
                n: float(v[place]) for n, v in rewards.items()
            }
            for name, value in WORLD.observe(after).items():
                assert torch.equal(value, observed[name][place])
            single[place] = after
        state = following


@pytest.mark.parametrize("scenario", range(9))
def test_the_states_of_a_round_are_counted(scenario):
    """60 cells of floor, less an obstacle's; with and without the victim, and home."""
    floor = sum(cell == "." for row in HOUSE for cell in row)
    assert floor == 60
    cells = floor - (scenario >= 3)
    # Without the victim their place cannot be stood on; with them the entrance ends the round.
    assert len(reachable(scenario)) == (cells - 1) + (cells - 1) + 1


def test_exact_values_are_those_of_the_shortest_way():
    """Undiscounted: 16 less a tenth for every step of the shortest way, from every state."""
    for scenario in (0, 4, 8):
        states = reachable(scenario)
        steps = {key: 0 if key[-1] else math.inf for key in states}
        ends = {
            key: [
                (*after.place.tolist(), bool(after.found), bool(after.home))
                for after in (WORLD.transition(state, torch.tensor(a)) for a in range(4))
            ]
            for key, state in states.items()
        }
        for _ in range(2 * len(states)):
            for key in states:
                steps[key] = min([steps[key], *(steps[end] + 1 for end in ends[key])])
        for key, state in states.items():
            value = float(WORLD.reference_values(state, 1.0).max())
            reward = 0.0 if key[-1] else 15.0 + (not key[2]) - 0.1 * steps[key]
            assert value == pytest.approx(reward, abs=1e-4)


def test_a_state_is_behind_its_observation_and_nearest_to_itself():
    for scenario in range(9):
        for state in reachable(scenario).values():
            observation = WORLD.observe(state)
            behind = WORLD.state_behind(observation)
            for name, value in WORLD.observe(behind).items():
                assert torch.equal(value, observation[name])
            assert torch.equal(behind.home, state.home)
    noise = torch.Generator().manual_seed(0)
    state = start(NINE)
    blurred = {
        name: value + 0.2 * torch.rand(value.shape, generator=noise)
        for name, value in WORLD.observe(state).items()
    }
    for name, value in WORLD.nearest(blurred).items():
        assert torch.equal(value, WORLD.observe(state)[name])


def test_what_cannot_be_is_reported():
    observation = WORLD.observe(start(NINE))
    assert not any(broken.any() for broken in WORLD.faults(observation).values())

    def fault(name, change):
        wrong = {key: value.clone() for key, value in observation.items()}
        change(wrong)
        found = [rule for rule, broken in WORLD.faults(wrong).items() if broken.any()]
        assert any(name in rule for rule in found), found

    def put(key, place, value):
        def change(wrong):
            wrong[key][(..., *place)] = value

        return change

    fault("walked on", put("ego", (0,), 4.0))  # row 4, column 4 is a wall
    fault("walked on", put("ego", (1,), 4.5))
    fault("carrying", put("ego", (2,), 0.5))
    fault("holds has", put("verbal", (0, 0), 2.0))
    fault("one corridor", put("verbal", (slice(0, 2), 0), 1.0))
    fault("in one room", put("verbal", (slice(2, 5), 0), 0.0))
    fault("in one room", put("ego", (2,), 1.0))
    fault("pixels", put("visual", (8, 0), 0.0))

"""The world of search and rescue: pure functions, by hand and against an exact planner."""

import itertools
import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from example_course import perceived

from mirror_ppl.domains import Domain
from mirror_ppl.domains.search_rescue import UTTERANCES, RescueState, SearchRescue
from mirror_ppl.domains.search_rescue.house import (
    ENTRANCE,
    HOUSE,
    OBSTACLES,
    PORTIONS,
    ROOMS,
    VICTIM,
    as_image,
    as_portions,
)
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models import HumanModel
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.training.views import draw_views

WORLD: Domain = SearchRescue()
UP, DOWN, LEFT, RIGHT = range(4)
NINE = torch.arange(9)


def start(scenario=None, number=9, seed=0):
    return WORLD.initial(number, torch.Generator().manual_seed(seed), scenario)


def alone(scenario):
    """The state at the start of one round."""
    state = start(torch.tensor([scenario]), 1)
    return RescueState(*(getattr(state, part.name)[0] for part in fields(state)))


def walk(state, actions):
    """States and rewards, term by term, along actions."""
    states, terms = [state], []
    for action in actions:
        chosen = torch.tensor(action)
        following = WORLD.transition(states[-1], chosen)
        found = WORLD.rewards(states[-1], chosen, following)
        terms.append({name: float(value) for name, value in found.items() if value})
        states.append(following)
    return states, terms


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


def reachable(scenario):
    """All states of a round, by trying every action."""
    found, waiting = {}, [alone(scenario)]
    while waiting:
        state = waiting.pop()
        key = (*state.place.tolist(), bool(state.found), bool(state.home))
        if key in found:
            continue
        found[key] = state
        waiting += [WORLD.transition(state, torch.tensor(action)) for action in range(4)]
    return found


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


def test_smoke_leaves_the_own_portion_to_see_and_nothing_to_hear():
    for scenario in (0, 5):
        for key, state in reachable(scenario).items():
            observation = WORLD.observe(state)
            seen = WORLD.visibility("smoke", observation)
            own = key[0] // 3 * 3 + key[1] // 3
            assert seen["visual"].nonzero().flatten().tolist() == [own]
            assert not seen["verbal"].any()
            clear = WORLD.visibility("clear", observation)
            assert clear["visual"].all() and clear["verbal"].all()
            # The bin of 1.5 cells sees the same.
            _, distance = WORLD.distance(observation)
            (bin_,) = [edge for edge in WORLD.reach_bins if edge == 1.5]
            assert torch.equal(distance <= bin_, seen["visual"])
    with pytest.raises(UnknownNameError, match="fog"):
        WORLD.visibility("fog", observation)


def test_radii_stand_for_all_that_see_the_same():
    radii = WORLD.reach_bins
    assert sorted(set(radii)) == list(radii) and 1.5 in radii
    portions = [0, 1, 2, 3, 5]
    distances = set()
    for state in reachable(0).values():
        _, distance = WORLD.distance(WORLD.observe(state))
        distances |= set(distance[portions].tolist())
    # One radius from each distance that can occur to the next.
    edges = [*sorted(distances), math.inf]
    assert len(radii) == len(distances)
    for least, radius, beyond in zip(edges, radii, edges[1:], strict=False):
        assert least <= radius < beyond


def test_pixels_show_the_house():
    state = alone(4)  # top-middle, left corridor blocked
    image = as_image(WORLD.observe(state)["visual"])
    assert image.shape == (9, 9, 3)
    assert image[4, 1].tolist() == pytest.approx(OBSTACLES[0])
    assert image[1, 4].tolist() == pytest.approx(VICTIM)
    for row, column in itertools.product(range(9), range(9)):
        dark = bool((image[row, column] < 0.3).all())
        assert dark == (HOUSE[row][column] == "#")
    assert torch.equal(as_portions(image), WORLD.observe(state)["visual"])
    # Found, the victim is no longer on the map, and nothing says that they are there.
    after = WORLD.observe(replace(state, found=torch.tensor(True)))
    assert as_image(after["visual"])[1, 4].tolist() == pytest.approx([0.9] * 3)
    assert after["verbal"][:, 0].tolist() == [1, 0, 0, 0, 0]
    assert after["ego"].tolist() == [8, 4, 1]
    image = torch.rand(2, 9, 9, 3)
    assert torch.equal(as_image(as_portions(image)), image)
    assert torch.equal(as_portions(image)[:, 5], image[:, 3:6, 6:9].flatten(1))
    picture = WORLD.render(state)
    assert picture.dtype == np.uint8 and picture.shape == (108, 108, 3)
    assert picture[8 * 12 + 6, 4 * 12 + 6].tolist() == [40, 90, 200]


def test_utterances_say_what_is_so():
    for scenario in range(9):
        observation = WORLD.observe(alone(scenario))
        said = [WORLD.describe(observation, "verbal", item) for item in UTTERANCES]
        where, blocked = WORLD.scenarios[scenario].split(", ")
        assert f"victim in {where.removeprefix('victim ')}" in said
        assert sum(text.startswith("victim in ") for text in said) == 1
        wrong = [text for text in said if text.endswith("blocked")]
        assert wrong == ([] if blocked.startswith("no") else [blocked])
    assert (
        WORLD.describe(observation, "visual", "top-left")
        == "the top-left of the map (victim not in top-left)"
    )
    assert WORLD.deed(observation, None, LEFT) == "go left"


def learned(state, shown=(), said=(), knowledge=None):
    observation = WORLD.observe(state)
    visible = {
        "visual": torch.tensor([name in shown for name in PORTIONS]),
        "verbal": torch.tensor([name in said for name in UTTERANCES]),
    }
    if knowledge is None:
        knowledge = WORLD.nothing_known()
    return WORLD.learn(knowledge, observation, visible, lambda supposed: visible)


def known(knowledge):
    items = WORLD.known(knowledge)
    names = {"visual": PORTIONS, "verbal": tuple(UTTERANCES)}
    return {
        name: {names[name][place] for place in mask.nonzero().flatten().tolist()}
        for name, mask in items.items()
    }


ALWAYS = {"middle-middle", "bottom-left", "bottom-middle", "bottom-right"}


def test_what_follows_is_known_and_stays_known():
    state = alone(5)  # top-right, left corridor blocked
    assert known(WORLD.nothing_known()) == {"visual": ALWAYS, "verbal": set()}
    # That a corridor is free says nothing of the other; that it is blocked, everything.
    one = learned(state, ["middle-right"])
    assert known(one) == {"visual": ALWAYS | {"middle-right"}, "verbal": {"right corridor"}}
    both = {"left corridor", "right corridor"}
    assert known(learned(state, said=["left corridor"]))["verbal"] == both
    # Of three rooms, two empty ones tell of the third; the one with the victim of both others.
    first = learned(state, ["top-left"])
    assert known(first)["verbal"] == {"top-left"}
    second = learned(state, said=["top-middle"], knowledge=first)
    assert known(second)["verbal"] == set(ROOMS)
    assert known(second)["visual"] == ALWAYS | set(ROOMS)
    assert known(learned(state, ["top-right"]))["verbal"] == set(ROOMS)
    assert known(learned(state, knowledge=second)) == known(second)
    # Whoever carries the victim knows that no room has them.
    carrying = replace(state, found=torch.tensor(True))
    assert known(learned(carrying))["verbal"] == set(ROOMS)


def test_knowledge_of_a_batch_is_that_of_each():
    state = start(NINE)
    shown = torch.rand(9, 9, generator=torch.Generator().manual_seed(0)) < 0.3
    said = torch.rand(9, 5, generator=torch.Generator().manual_seed(1)) < 0.2
    nothing = WORLD.nothing_known(9)
    visible = {"visual": shown, "verbal": said}
    together = WORLD.learn(nothing, WORLD.observe(state), visible, lambda supposed: visible)
    for place in range(9):
        names = [PORTIONS[k] for k in shown[place].nonzero().flatten().tolist()]
        spoken = [list(UTTERANCES)[k] for k in said[place].nonzero().flatten().tolist()]
        own = learned(alone(place), names, spoken)
        assert torch.equal(own.corridors, together.corridors[place])
        assert torch.equal(own.rooms, together.rooms[place])


def test_relevant_are_the_victim_and_the_obstacle():
    (relevant,) = WORLD.relevance(WORLD.observe(start(NINE))).values()
    assert relevant["verbal"].sum(-1).tolist() == relevant["visual"].sum(-1).tolist()
    assert relevant["visual"].sum(-1).tolist() == [1] * 3 + [2] * 6
    assert [PORTIONS[k] for k in relevant["visual"][5].nonzero().flatten()] == [
        "top-right",
        "middle-left",
    ]


def test_costs_are_those_of_the_supplement():
    visual, verbal = WORLD.modalities
    assert (visual.cost_coefficient, verbal.cost_coefficient) == (0.02, 0.1)
    assert float(visual.cost(torch.tensor(3))) == pytest.approx(0.18)
    assert float(verbal.cost(torch.tensor(2))) == pytest.approx(0.4)
    communicable = WORLD.communicable(WORLD.observe(alone(0)))
    assert communicable["visual"].shape == (9,) and communicable["verbal"].shape == (5,)
    assert communicable["visual"].all() and communicable["verbal"].all()


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


def test_networks_read_pixels_and_places():
    symbols = WORLD.symbols(WORLD.observe(start(NINE)))
    for name, size in WORLD.symbol_sizes.items():
        assert symbols[name].shape[-1] == size
    assert symbols["ego"][0].nonzero().flatten().tolist() == [8, 9 + 4]
    assert symbols["verbal"].sum(-1).tolist() == [[1.0] * 5] * 9


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


# --- models of people in it


def test_a_person_sees_as_far_as_their_radius_and_remembers():
    """An encoder that was not trained is enough to see."""
    torch.manual_seed(0)
    human = HumanModel(SelfModel(WORLD))
    state = alone(5)  # top-right, left corridor blocked
    states, _ = walk(state, [RIGHT] * 3 + [UP] * 7)
    observed = [WORLD.observe(one) for one in states]
    observation = {name: torch.stack([one[name] for one in observed])[None] for name in observed[0]}
    steps = len(states)
    told = {m.name: torch.zeros(1, steps, len(m.items), dtype=torch.bool) for m in WORLD.modalities}
    smoke = next(place for place, edge in enumerate(WORLD.reach_bins) if edge == 1.5)
    everything = len(WORLD.reach_bins) - 1
    implants = {
        "sight_radius": torch.tensor([smoke, everything, smoke]),
        "assumes_open": torch.tensor([0, 0, 1]),
    }
    view = perceived(human, implants, observation, told)
    assert view.visible["visual"].shape == (3, steps, 9)
    assert view.visible["verbal"].shape == (3, steps, 5)
    assert not any(mask[:2].any() for mask in view.taken.values())
    assert view.visible["visual"][1].all() and view.visible["verbal"][1].all()
    seen = [{PORTIONS[k] for k in row.nonzero().flatten()} for row in view.visible["visual"][0]]
    assert seen[0] == ALWAYS
    assert seen[6] == ALWAYS | {"middle-right"}  # row 5 of the corridor
    assert seen[9] == ALWAYS | {"middle-right"} | set(ROOMS)  # the victim: no other room has one
    # Who takes corridors to be open does so until they know better: then of the left one alone.
    taken = {name: mask[2] for name, mask in view.taken.items()}
    both, left = [0, 0, 0, 1, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0, 0, 0]
    assert taken["visual"][0].int().tolist() == both
    assert taken["visual"][6].int().tolist() == left
    assert taken["verbal"][0].int().tolist() == [1, 1, 0, 0, 0]
    assert taken["verbal"][6].int().tolist() == [1, 0, 0, 0, 0]
    free = WORLD.observe(replace(states[0], blocked=torch.zeros_like(states[0].blocked)))
    assert torch.equal(view.imagined["visual"][2, 0], free["visual"])
    assert torch.equal(view.imagined["verbal"][2, 0], free["verbal"])
    check_contract(human, shipped=True)


def test_an_obstacle_of_which_nothing_is_known_may_be_taken_not_to_be_there():
    state = start(number=3)
    state = replace(state, blocked=torch.tensor([0, 1, 2]))
    knowledge = WORLD.nothing_known(3)
    makes, open_to_them = torch.ones(3).bool(), torch.zeros(3).bool()

    def supposed(corridors, assumes):
        own = replace(knowledge, corridors=torch.tensor(corridors))
        return WORLD.supposed(state, own, {"open": assumes}).blocked.tolist()

    nothing, right = [[False, False]] * 3, [[False, True]] * 3
    assert supposed(nothing, makes) == [0, 0, 0]
    assert supposed(nothing, open_to_them) == [0, 1, 2]
    assert supposed(right, makes) == [0, 0, 2]


def test_views_to_train_on_have_the_items_of_each_modality():
    generator = torch.Generator().manual_seed(0)
    plan = draw_views(WORLD, 20, 3, generator)
    state = start(number=20)
    observation = {name: value[:, None] for name, value in WORLD.observe(state).items()}
    visible, knowledge = plan.look(WORLD, WORLD.nothing_known(20, 1), observation, 0)
    assert visible["visual"].shape == (20, 1, 9) and visible["verbal"].shape == (20, 1, 5)
    taken = plan.taken(WORLD, knowledge, observation)
    corridors = ~knowledge.corridors & plan.assumes["open"][:, None, None]
    assert corridors.any() and torch.equal(taken["verbal"][..., :2], corridors)
    assert torch.equal(taken["visual"][..., [3, 5]], corridors)
    assert not taken["verbal"][..., 2:].any() and not taken["visual"][..., :3].any()

"""What remembering and assuming observers are trained on: their views, and the world they live in.

Their knowledge itself is tested in ``test_driving_knowledge.py``.
"""

import math
from dataclasses import fields, replace
from itertools import product

import pytest
import torch

from mirror_ppl.domains import get_domain
from mirror_ppl.domains.base import map_state, roll_out
from mirror_ppl.domains.driving import CAR_LANES, CARS, ROAD_END, DrivingState
from mirror_ppl.domains.driving.people import Memory, remember
from mirror_ppl.evaluation.self_model import exact_values, fixed_views
from mirror_ppl.training.experience import Course, experience, follow, supposed
from mirror_ppl.training.views import ASSUMPTION_PROBABILITY, KIND_PROBABILITIES, draw_views

DRIVING = get_domain("driving")
STEPS = DRIVING.horizon
FRONT_LEFT, FRONT_RIGHT, REAR_LEFT, REAR_RIGHT = range(len(CARS))
NAMES = ("visual", "verbal")
STAY4 = torch.zeros(1, 4, dtype=torch.long)
BOTH = list(product((False, True), repeat=2))


def four_cars():
    """Two of them ahead or abreast and two behind; all but the last draw away. The ego is left."""
    return DrivingState(
        lane=torch.tensor([0]),
        position=torch.tensor([[5, 0, -3, -8]]),
        speed=torch.tensor([[1, -1, -1, 1]]),
    )


def one_plan(reach, clear=True, closing=True, remembers=True, **told):
    """A view of one round with a reach in each direction; ``told`` are cars and steps."""
    plan = fixed_views(DRIVING, 1, torch.Generator(), reach)
    for name in NAMES:
        plan.noise[name][..., 1] = 1.0
        for car, step in told.get(name, ()):
            plan.noise[name][0, step, car, 1] = 0.0
    return replace(
        plan,
        told=dict.fromkeys(NAMES, torch.tensor([0.5])),
        remembers=torch.tensor([remembers]),
        assumes={"clear": torch.tensor([clear]), "closing": torch.tensor([closing])},
    )


def rounds_seen(plan, start, actions):
    """States, what is visible of them, and what is known after each."""
    states = roll_out(DRIVING, start, actions)
    return states, *follow(DRIVING, plan, DRIVING.observe(states))


def marks(mask, car):
    """One car's mask in the only round, by step, as 0 and 1."""
    return mask[0, :, car].int().tolist()


# --- what is remembered -----------------------------------------------------------------------


@pytest.mark.parametrize("remembers", [True, False])
def test_what_was_seen_twice_or_heard_once_stays_visible(remembers):
    # A slow car ahead is passed; one draws away; one is spoken of at step 2, and one never.
    start = replace(
        four_cars(), position=torch.tensor([[3, 2, -5, -5]]), speed=torch.tensor([[-1, 1, -1, -1]])
    )
    plan = one_plan((2.0, 2.0, 0.0, 0.0), remembers=remembers, verbal=[(REAR_RIGHT, 2)])
    actions = torch.zeros(1, 5, dtype=torch.long)
    _, visible, knowledge = rounds_seen(plan, start, actions)
    visual, verbal = ([marks(visible[name], car) for car in range(4)] for name in NAMES)
    # Of what is known, that is remembered or not; what is known does not depend on it.
    known = [marks(knowledge.known, car) for car in range(4)]
    assert known == [
        [0, 0, 1, 1, 1, 1],  # in sight at 2, 1 and 0 cells
        [0, 1, 1, 1, 1, 1],  # in sight at 2 cells, and not at 1 cell, where it would come closer
        [0, 0, 0, 0, 0, 0],
        [0, 0, 1, 1, 1, 1],
    ]
    seen = [[0, 1, 1, 1, 0, 0], [1, 0, 0, 0, 0, 0], [0] * 6, [0] * 6]
    heard = [[0] * 6, [0] * 6, [0] * 6, [0, 0, 1, 0, 0, 0]]
    if remembers:
        assert visual == [[0, 1, 1, 1, 1, 1], [1, 1, 1, 1, 1, 1], [0] * 6, [0, 0, 1, 1, 1, 1]]
        assert verbal == known
    else:
        assert visual == seen
        assert verbal == heard


def test_a_car_shown_and_seen_is_seen_twice():
    # At 5 cells it is shown, and at 2, three steps later, it comes into sight.
    start = replace(four_cars(), speed=torch.tensor([[-1, -1, -1, 1]]))
    for shown, expected in (([], [0, 0, 0, 0, 1]), ([(FRONT_LEFT, 0)], [0, 0, 0, 1, 1])):
        plan = one_plan((2.0, 0.0, 0.0, 0.0), visual=shown)
        _, visible, _ = rounds_seen(plan, start, STAY4)
        assert marks(visible["verbal"], FRONT_LEFT) == expected
        assert marks(visible["visual"], FRONT_LEFT) == [int(bool(shown)), 0, 0, 1, 1]


@pytest.fixture(scope="module")
def many():
    """4,000 rounds with random actions, each under a view of its own.

    In those with limited sight, nobody sees as far as the end of the road.
    """
    generator = torch.Generator().manual_seed(5)
    plan = draw_views(DRIVING, 4000, STEPS, generator)
    reach = torch.where(plan.remembers[:, None], plan.reach.clamp(max=6.0), plan.reach)
    start = DRIVING.initial(4000, generator)
    actions = torch.randint(2, (4000, STEPS), generator=generator)
    return replace(plan, reach=reach), start, actions


def test_in_training_what_was_seen_twice_or_heard_stays_visible_in_sight_views_alone(many):
    plan, start, actions = many
    states, visible, _ = rounds_seen(plan, start, actions)
    observed, sight = plan.visibility(DRIVING, DRIVING.observe(states)), plan.remembers
    seen, heard = (observed[name].cumsum(1) for name in NAMES)
    known = (seen >= 2) | (heard >= 1)
    for name in NAMES:
        assert torch.equal(visible[name][~sight], observed[name][~sight])
        assert visible[name][sight][known[sight]].all()
        # Beyond that, only what was seen once and then missed where it was assumed to be.
        missed = (visible[name] & ~observed[name] & ~known)[sight]
        assert missed.any() and (seen[sight][missed] == 1).all()


# --- what is assumed --------------------------------------------------------------------------


def test_assumptions_are_made_in_sight_views_as_often_as_stated():
    number = 20_000
    plan = draw_views(DRIVING, number, STEPS, torch.Generator().manual_seed(3))
    sight = plan.remembers
    count = int(sight.sum())
    assert abs(count / number - KIND_PROBABILITIES[2]) < 4 * math.sqrt(0.25 / number)
    assert tuple(plan.assumes) == DRIVING.assumptions
    made = torch.stack(list(plan.assumes.values()), -1)
    assert not made[~sight].any()

    def assert_share(chosen, share, of):
        error = math.sqrt(share * (1 - share) / of)
        assert chosen.float().mean().item() == pytest.approx(share, abs=4.5 * error)

    p = ASSUMPTION_PROBABILITY
    # Each by itself: both, either or none, whatever is seen and whoever is spoken to.
    for which in BOTH:
        share = math.prod(p if makes else 1 - p for makes in which)
        assert_share((made[sight] == torch.tensor(which)).all(-1), share, count)
    spoken_to = sight & (plan.told["visual"] > 0)
    for group in (spoken_to, sight & ~spoken_to, sight & (plan.reach[:, 0] <= 1)):
        for index in range(2):
            assert_share(made[group][:, index], p, int(group.sum()))


def test_only_assumers_take_things_for_granted(many):
    plan, start, actions = many
    states, visible, knowledge = rounds_seen(plan, start, actions)
    observation = DRIVING.observe(states)
    taken = plan.taken(DRIVING, knowledge, observation)
    clear, closing = (plan.assumes[name] for name in DRIVING.assumptions)
    never = ~(visible["visual"] | visible["verbal"]).cummax(1).values
    unsure = knowledge.unsure
    assert torch.equal(taken["verbal"], unsure & closing[:, None, None])
    assert torch.equal(
        taken["visual"], (never & clear[:, None, None]) | (unsure & closing[:, None, None])
    )
    assert taken["visual"][clear & ~closing].any() and taken["verbal"][closing & ~clear].any()
    # The world is as it is but for what is taken for granted.
    believed = DRIVING.observe(supposed(DRIVING, plan, states, knowledge))
    for name in NAMES:
        different = (believed[name] != observation[name]).any(-1)
        assert not (different & ~taken["visual"]).any()
        assert (different & taken["visual"])[clear | closing].any()


# --- the world of a person who assumes --------------------------------------------------------

REACH = (2.0, 2.0, 3.0, 0.0)


def lived_by(clear, closing):
    """Four steps in the left lane; the car ahead is shown at the first."""
    plan = one_plan(REACH, clear, closing, visual=[(FRONT_LEFT, 0)])
    return plan, experience(DRIVING, Course.of(DRIVING, four_cars(), STAY4), plan)


@pytest.mark.parametrize(("clear", "closing"), BOTH)
def test_observations_of_a_person_who_assumes_that_cars_come_closer(clear, closing):
    """Each car that was seen comes closer until it is missed where it should be in sight.

    The car ahead at 2 cells, at step 3. The others at step 1 already: one abreast in the other lane
    should be a cell ahead, and the one behind 2 cells behind.
    """
    rounds = lived_by(clear, closing)[1].rounds
    places = rounds.observation["visual"][0, :, :, 0].T.tolist()
    ahead = [5, 4, 3, 8, 9] if closing else [5, 6, 7, 8, 9]
    unseen = [ROAD_END] * 5 if clear else [-8, -7, -6, -5, -4]
    assert places == [ahead, [0, -1, -2, -3, -4], [-3, -4, -5, -6, -7], unseen]
    speeds = rounds.observation["verbal"][0, :, :, 2].T.tolist()
    if closing:
        first = [[-1, -1, -1, 1, 1], [1, -1, -1, -1, -1], [1, -1, -1, -1, -1]]
    else:
        first = [[1] * 5, [-1] * 5, [-1] * 5]
    assert speeds == [*first, [0] * 5 if clear else [1] * 5]
    shown, said = ([marks(rounds.visible[name], car) for car in range(4)] for name in NAMES)
    between, first = int(closing), [int(closing), 1, 1, 1, 1]
    assert shown == [[1, between, between, 1, 1], [1] * 5, [1] * 5, [int(clear)] * 5]
    assert said == [[between] * 3 + [1, 1], first, first, [0] * 5]
    assert torch.equal(rounds.observation["ego"], torch.zeros(1, 5, 1))


@pytest.mark.parametrize(("clear", "closing"), BOTH)
def test_outcomes_are_those_that_an_assumer_expects(clear, closing):
    lived = lived_by(clear, closing)[1]
    stay, switch = lived.outcomes
    unseen = [ROAD_END] * 4 if clear else [-7, -6, -5, -4]
    if closing:
        places = [[4, 3, 2, 9], [1, -2, -3, -4], [-2, -5, -6, -7], unseen]
        speeds = [[-1, -1, -1, 1], [1, -1, -1, -1], [1, -1, -1, -1]]
        # They would have the car behind at 2 cells, and later the one ahead.
        rewards = [-2.0, 0.0, -2.0, 0.0]
    else:
        places = [[6, 7, 8, 9], [-1, -2, -3, -4], [-4, -5, -6, -7], unseen]
        speeds = [[1] * 4, [-1] * 4, [-1] * 4]
        rewards = [0.0, 0.0, 0.0, 0.0]
    for outcome in (stay, switch):
        assert outcome.observation["visual"][0, :, :, 0].T.tolist() == places
        assert outcome.observation["verbal"][0, :, :3, 2].T.tolist() == speeds
    assert stay.reward.tolist() == [rewards]
    assert torch.equal(lived.rounds.rewards, stay.reward)
    # At right is the car that was abreast, at most 2 cells away for two steps.
    assert switch.reward.tolist() == [[-3.0, -3.0, -1.0, -1.0]]
    # The car ahead is not shown again; not expected closer, it is missed only at step 3.
    ahead = [1] * 4 if closing else [0, 0, 1, 1]
    for name in NAMES:
        known = [marks(stay.visible[name], car) for car in range(3)]
        assert known == [ahead, [1] * 4, [1] * 4]
        assert marks(stay.visible[name], REAR_RIGHT) == [int(clear and name == "visual")] * 4
    # From the other lane nothing is seen behind: the car there is known of only if assumed.
    behind = [int(closing), 1, 1, 1]
    assert [marks(switch.visible[name], REAR_LEFT) for name in NAMES] == [behind, behind]


def test_the_believed_world_is_the_one_that_drivers_remember(generator):
    """Simulated drivers take the same for granted, and plan with what they remember.

    They see nothing at the end of the road, so nobody here sees that far.
    """
    number = 1500
    start = DRIVING.initial(number, generator)
    actions = torch.randint(2, (number, STEPS), generator=generator)
    plan = draw_views(DRIVING, number, STEPS, generator)
    edges = torch.tensor(DRIVING.reach_bins[:-1])
    everybody = torch.ones(number, dtype=torch.bool)
    plan = replace(
        plan,
        reach=edges[torch.randint(len(edges), (number, 4), generator=generator)],
        keep={"visual": torch.ones(number), "verbal": torch.zeros(number)},
        told=dict.fromkeys(NAMES, torch.full((number,), 0.05)),
        remembers=everybody,
        assumes=dict.fromkeys(DRIVING.assumptions, everybody),
    )
    rounds = experience(DRIVING, Course.of(DRIVING, start, actions), plan).rounds
    observation = DRIVING.observe(roll_out(DRIVING, start, actions))
    observed = plan.visibility(DRIVING, observation)
    memory, wrong = Memory.empty((number,)), 0
    for step in range(STEPS + 1):
        now = {name: value[:, step] for name, value in observation.items()}
        told = {name: mask[:, step] for name, mask in observed.items()}
        memory = remember(memory, now, told["visual"], told, plan.reach)
        here = memory.known & (memory.position.abs() < ROAD_END)
        verbal = rounds.observation["verbal"][:, step]
        assert torch.equal(verbal[..., 0].abs() < ROAD_END, here)
        assert torch.equal(verbal[..., 0][here], memory.position[here])
        assert torch.equal(verbal[..., 2][here], memory.speed[here])
        assert rounds.visible["visual"][:, step].all()
        assert rounds.visible["verbal"][:, step][here].all()
        wrong += (verbal != now["verbal"]).any(-1)[memory.known].sum()
        if step < STEPS:
            action = actions[:, step]
            lane = now["ego"][:, 0].long() ^ action
            gap = torch.where(here, memory.position + memory.speed, torch.inf).abs()
            gap = torch.where(torch.tensor(CAR_LANES) == lane[:, None], gap, torch.inf)
            expected = -2.0 * (gap <= 2).sum(-1) - 5.0 * (gap == 0).sum(-1) - action
            assert torch.equal(rounds.rewards[:, step], expected)
    assert wrong > number / 4  # cars that they take to be elsewhere


# --- the exact planner of a view --------------------------------------------------------------


@pytest.mark.parametrize(("clear", "closing"), BOTH)
def test_the_exact_planner_of_a_view_plans_in_the_believed_world(clear, closing):
    plan, _ = lived_by(clear, closing)
    found = exact_values(DRIVING, four_cars(), STAY4, plan, 0.9)
    # Cars that are known are as they are; those that are not are known from some step on.
    position, speed = torch.tensor([5, 0, -3, -8]), torch.tensor([1, -1, -1, 1])
    for step, known_ahead in enumerate((False, False, False, True)):
        real = DrivingState(torch.tensor(0), position + step * speed, speed.clone())
        if closing and not known_ahead:
            real.position[FRONT_LEFT], real.speed[FRONT_LEFT] = 5 - step, -1
        if closing and step == 0:
            real.speed[[FRONT_RIGHT, REAR_LEFT]] = 1
        if clear:
            real.position[REAR_RIGHT], real.speed[REAR_RIGHT] = 1000, 0
        expected = DRIVING.reference_values(real, 0.9)
        torch.testing.assert_close(found[0, step], expected)


def test_fixed_views_remember_and_assume_only_where_sight_is_limited(generator):
    start = DRIVING.initial(50, generator)
    actions = torch.randint(2, (50, STEPS), generator=generator)
    for reach in (None, (2.0, 2.0, 0.0, 0.0)):
        plan = fixed_views(DRIVING, 50, generator, reach)
        for made in plan.assumes.values():
            assert made.tolist() == [reach is not None] * 50
        states, visible, knowledge = rounds_seen(plan, start, actions)
        if reach is None:
            # Whoever sees everything knows everything from the second look on.
            assert visible["visual"].all() and knowledge.known[:, 1:].all()
            assert not visible["verbal"][:, 0].any() and visible["verbal"][:, 1:].all()
            believed = supposed(DRIVING, plan, states, knowledge)
            parts = (field.name for field in fields(states))
            assert all(torch.equal(getattr(believed, p), getattr(states, p)) for p in parts)
        else:
            assert not visible["visual"].all()
            assert torch.equal(visible["verbal"], knowledge.known)
            first = map_state(lambda part: part[:, 0], knowledge)
            assert not first.known.any() and first.unsure.any()

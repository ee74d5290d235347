"""What was told or seen lasts: in what people perceive and believe, and in planning."""

import example_course
import pytest
import torch
from example_course import beliefs_of
from example_person import (
    BLIND,
    CHANNELS,
    DOMAIN,
    FULL_SIGHT,
    SIGHTS,
    begun,
    beliefs_before,
    flags,
    human,
    observed,
    person,
)

from mirror_ppl.domains.driving import CARS, DrivingState
from mirror_ppl.models import View
from mirror_ppl.models.implants import assumption_sites

STEPS = 4
NAMES = ("visual", "verbal")
FRONT_LEFT, FRONT_RIGHT, REAR_LEFT, REAR_RIGHT = range(4)
LEAVING = (FRONT_RIGHT, REAR_RIGHT)  # in `far_off`; the others close in


def told_at(*times, steps=STEPS):
    """Masks ``[T, K]``: item k is told at the k-th of these times, or never."""
    mask = torch.zeros(steps, len(times), dtype=torch.bool)
    for item, time in enumerate(times):
        if time is not None:
            mask[time, item] = True
    return mask


def told_of(car, *times):
    """Masks ``[1, T, 4]``: one car is told of at these times."""
    mask = torch.zeros(1, STEPS, 4, dtype=torch.bool)
    mask[0, list(times), car] = True
    return mask


def since(*times, steps=STEPS):
    """Masks ``[T, K]``: item k at the k-th of these times and ever after, or never."""
    begin = torch.tensor([steps if time is None else time for time in times])
    return torch.arange(steps)[:, None] >= begin


def viewer(sight=BLIND, clear=1, closing=1):
    """Implants ``[1]`` of a person with the same sight in all directions."""
    assumes = dict(zip(assumption_sites(DOMAIN), (clear, closing), strict=True))
    return {k: torch.tensor([v]) for k, v in (dict.fromkeys(SIGHTS, sight) | assumes).items()}


def far_off(steps=STEPS):
    """Observations ``[1, T, ...]`` of cars, all on the road, the left ones of which close in."""
    start = DrivingState(
        torch.tensor([0]), torch.tensor([[9, 7, -9, -7]]), torch.tensor([[-1, 1, 1, -1]])
    )
    states = [start]
    for _ in range(steps - 1):
        states.append(DOMAIN.transition(states[-1], torch.tensor([0])))
    seen = [observed(state) for state in states]
    return {name: torch.stack([now[name] for now in seen])[None] for name in seen[0]}


def perceived(implants=None, steps=STEPS, **told):
    nothing = torch.zeros(1, steps, 4, dtype=torch.bool)
    given = dict.fromkeys(NAMES, nothing) | told
    return example_course.perceived(human(), implants or viewer(), far_off(steps), given)


def parts_of(view):
    """Everything that a view holds; in driving nothing ever stays as it is."""
    assert view.still is None
    return view.visible, view.taken, view.imagined


def same(first, second):
    """Whether two views hold the same masks and values."""
    return all(
        one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)
        for one, other in zip(parts_of(first), parts_of(second), strict=True)
    )


# --- what lasts -------------------------------------------------------------------------------


def test_what_is_said_once_is_known_from_then_on():
    view = perceived(verbal=told_at(0, 2, None, 3)[None])
    for name in NAMES:  # place and speed
        assert torch.equal(view.visible[name][0], since(0, 2, None, 3)), name


def test_what_is_shown_twice_is_known_from_then_on():
    shown = told_at(0, 1, None, 2) | told_at(1, 3, 3, None)
    view = perceived(visual=shown[None])
    known = since(1, 3, None, None)
    assert torch.equal(view.visible["visual"][0], shown | known)
    assert torch.equal(view.visible["verbal"][0], known)


def test_cars_become_known_one_by_one():
    """Two cars that were shown once are not one that was shown twice."""
    shown = told_at(0, 1, 2, 3)
    view = perceived(visual=shown[None])
    assert torch.equal(view.visible["visual"][0], shown)
    assert not view.visible["verbal"].any()
    view = perceived(visual=shown[None], verbal=told_at(1, None, None, 3)[None])
    assert torch.equal(view.visible["verbal"][0], since(1, None, None, 3))
    assert torch.equal(view.visible["visual"][0], shown | since(1, None, None, 3))


def test_a_car_seen_once_and_shown_once_is_known():
    """They see as far as six cells: the car ahead that closes in comes within sight at step 3."""
    six = DOMAIN.reach_bins.index(6.0)
    view = perceived(viewer(six), visual=told_of(FRONT_LEFT, 1))
    assert torch.equal(view.visible["verbal"][0], since(3, None, None, None))
    alone = perceived(viewer(six))
    assert alone.visible["visual"][0, 3, FRONT_LEFT]
    assert not alone.visible["verbal"].any()


def test_what_is_seen_twice_is_known_without_a_word():
    view = perceived(viewer(FULL_SIGHT))
    assert view.visible["visual"].all()
    assert torch.equal(view.visible["verbal"][0], since(1, 1, 1, 1))


def test_rounds_are_remembered_one_by_one(generator):
    told = {name: torch.rand(9, STEPS, 4, generator=generator) < 0.2 for name in NAMES}
    before = {name: mask.clone() for name, mask in told.items()}
    together = perceived(**told).map(lambda part: part.expand(9, *part.shape[1:]))
    for name in NAMES:
        assert torch.equal(told[name], before[name])  # what was given is left as it was
    for row in range(9):
        alone = perceived(**{name: mask[row : row + 1] for name, mask in told.items()})
        own = ({k: v[row : row + 1] for k, v in part.items()} for part in parts_of(together))
        assert same(alone, View(*own))


def test_the_first_step_is_as_communicated(generator):
    told = {name: torch.rand(9, 1, 4, generator=generator) < 0.5 for name in NAMES}
    view = perceived(steps=1, **told)
    assert torch.equal(view.visible["visual"], told["visual"] | told["verbal"])
    assert torch.equal(view.visible["verbal"], told["verbal"])


def test_communicating_again_what_is_known_changes_nothing(generator):
    told = {name: torch.rand(9, STEPS, 4, generator=generator) < 0.2 for name in NAMES}
    view = perceived(**told)
    assert not torch.equal(view.visible["verbal"], told["verbal"])
    assert same(perceived(**view.visible), view)


# --- what a person makes of it ----------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("time", range(STEPS))
@pytest.mark.parametrize("car", range(4))
def test_communicated_items_are_no_longer_assumed_absent(name, time, car):
    told = told_of(car, time)
    placed = since(*(time if index == car else None for index in range(4)))
    view = perceived(viewer(closing=0), **{name: told})
    assert torch.equal(view.taken["visual"][0], ~placed)
    assert not view.taken["verbal"].any()
    neither = perceived(viewer(clear=0, closing=0), **{name: told})
    assert not any(mask.any() for mask in neither.taken.values())
    # What was said is in view from then on; what was shown may be taken to close in.
    view = perceived(viewer(clear=0), **{name: told})
    if name == "verbal":
        assert all(torch.equal(view.visible[part][0], placed) for part in NAMES)
        assert not any(mask.any() for mask in view.taken.values())
    else:
        assert torch.equal(view.visible["visual"], told) and not view.visible["verbal"].any()
        assert torch.equal(view.taken["visual"][0], placed & ~told[0])
        assert torch.equal(view.taken["verbal"][0], placed)


def believed(implants, **told):
    done = torch.zeros(1, STEPS, dtype=torch.long)
    return beliefs_of(human(), perceived(implants, **told), far_off(), done)[0]


def differ(first, second):
    """At which steps two beliefs differ, and by more than rounding."""
    return ((first - second).abs().amax(-1) > 0.01).tolist()


@pytest.mark.parametrize("car", range(4))
def test_beliefs_follow_a_car_that_was_spoken_of_once(car):
    """As if it were told of at each step; and not as if it were told of never, or later."""
    implants = viewer(clear=0, closing=0)
    once = believed(implants, verbal=told_of(car, 1))
    always = told_of(car, 1, 2, 3)
    torch.testing.assert_close(once, believed(implants, verbal=always), rtol=0, atol=0)
    both = believed(implants, verbal=always, visual=always)
    torch.testing.assert_close(once, both, rtol=0, atol=0)
    assert differ(once, believed(implants)) == [False, True, True, True]
    assert differ(once, believed(implants, verbal=told_of(car, 2)))[1]


@pytest.mark.parametrize("car", range(4))
def test_beliefs_follow_a_car_that_was_shown_twice(car):
    implants = viewer(clear=0, closing=0)
    twice = believed(implants, visual=told_of(car, 0, 1))
    always = told_of(car, 0, 1, 2, 3)
    torch.testing.assert_close(twice, believed(implants, visual=always), rtol=0, atol=0)
    spoken = believed(implants, visual=told_of(car, 0), verbal=told_of(car, 1))
    torch.testing.assert_close(twice, spoken, rtol=0, atol=0)
    once = believed(implants, visual=told_of(car, 0))
    assert differ(twice, once) == [False, True, True, True]


@pytest.mark.parametrize("car", range(4))
def test_beliefs_about_a_car_shown_once_are_those_of_one_that_closes_in(car):
    """Right of a car that does: as if it were known. Wrong of one that leaves."""
    shown, spoken = told_of(car, 1), told_of(car, 1)
    closing = believed(viewer(clear=0), visual=shown)
    known = believed(viewer(clear=0), verbal=spoken)
    if car in LEAVING:
        assert differ(closing, known) == [False, True, True, True]
    else:
        torch.testing.assert_close(closing, known)
    open_minded = believed(viewer(clear=0, closing=0), visual=shown)
    assert differ(closing, open_minded) == [False, True, True, True]


# --- planning step by step --------------------------------------------------------------------


def after(beliefs, which, past, message, action):
    """Beliefs after a step, and which of them a person has."""
    one = torch.zeros(1, dtype=torch.long)
    transition = person().transition(
        one,
        one + action,
        {name: value[None] for name, value in past.now.items()},
        CHANNELS.split(message[None]),
    )
    return beliefs.at(which).after(transition).distinct()


def names(mask):
    return [name for name, marked in zip(CARS, mask.tolist(), strict=True) if marked]


def lasting(beliefs, which):
    """Cars of which a person knows how they move, and cars of which they know only the place."""
    knowledge = beliefs.knowledge
    known = DOMAIN.known(knowledge)
    unsure = DOMAIN.assume(knowledge, beginning().now)[0]["closing"]
    assert torch.equal(known["visual"], known["verbal"])
    assert torch.equal(unsure["visual"], unsure["verbal"])
    return names(known["visual"][which[0]]), names(unsure["visual"][which[0]])


def beginning():
    return begun(0, [9, 8, -9, -8], [-1, -1, 1, 1])


def steps_of_planning(*messages):
    """What lasts for a blind person after each of these messages."""
    past = beginning()
    beliefs, which = beliefs_before(person(), past)
    result, action = [], len(DOMAIN.actions)
    for message in messages:
        beliefs, which = after(beliefs, which, past, message, action)
        action = 0
        result.append(lasting(beliefs, which))
    return result


def test_planning_remembers_what_was_said():
    silence, rear, front = flags(), flags(verbal=["rear-left"]), flags(verbal=["front-left"])
    lasts = steps_of_planning(silence, rear, silence, front, silence)
    both = ["front-left", "rear-left"]
    assert lasts == [([], []), *[(["rear-left"], [])] * 2, *[(both, [])] * 2]


def test_planning_remembers_what_was_shown():
    silence, rear, front = flags(), flags(visual=["rear-left"]), flags(visual=["front-left"])
    lasts = steps_of_planning(rear, silence, front | rear, silence, front)
    both = ["front-left", "rear-left"]
    assert lasts == [
        *[([], ["rear-left"])] * 2,
        *[(["rear-left"], ["front-left"])] * 2,
        (both, []),
    ]


def test_planning_continues_from_the_messages_of_the_round_so_far():
    past = beginning()
    message = flags(visual=["front-left"], verbal=["rear-right"])
    past = past.then(CHANNELS.split(message), 0, past.now)
    past = past.then(CHANNELS.split(flags()), 0, past.now)
    beliefs, which = beliefs_before(person(), past)
    assert lasting(beliefs, which) == (["rear-right"], ["front-left"])
    later, then = after(beliefs, which, past, flags(verbal=["front-right"]), 0)
    assert lasting(later, then) == (["front-right", "rear-right"], ["front-left"])
    never = DOMAIN.assume(later.knowledge, past.now)[0]["clear"]["visual"]
    assert names(never[then[0]]) == ["rear-left"]
    # A second sight counts, the first having been before planning began.
    later, then = after(beliefs, which, past, flags(visual=["front-left"]), 0)
    assert lasting(later, then) == (["front-left", "rear-right"], [])

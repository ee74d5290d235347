"""What was told stays known, shown or said: in masks, in what people perceive, and in planning."""

import pytest
import torch
from example_person import BLIND, CHANNELS, DOMAIN, SIGHTS, begun, flags, human, person

from mirror_ppl.communication.minds import Looks, StepwiseBeliefs
from mirror_ppl.domains.base import digested

STEPS = 4
NAMES = ("visual", "verbal")


def told_at(*times, steps=STEPS):
    """Masks ``[T, K]``: item k is told at the k-th of these times, or never."""
    mask = torch.zeros(steps, len(times), dtype=torch.bool)
    for item, time in enumerate(times):
        if time is not None:
            mask[time, item] = True
    return mask


# --- digested ---------------------------------------------------------------------------------


def test_what_is_told_is_known_from_then_on():
    known = digested({"shown": told_at(0, 2, None)})["shown"]
    assert known.dtype == torch.bool
    assert known.tolist() == [
        [True, False, False],
        [True, False, False],
        [True, True, False],
        [True, True, False],
    ]


def test_modalities_are_digested_one_by_one():
    """Being told of an item in one modality is not being told of it in another."""
    known = digested({"first": told_at(1, None), "second": told_at(None, 2)})
    assert known["first"].tolist() == [[False, False]] + [[True, False]] * 3
    assert known["second"].tolist() == [[False, False]] * 2 + [[False, True]] * 2


def test_rounds_are_digested_one_by_one(generator):
    told = torch.rand(5, 7, STEPS, 3, generator=generator) < 0.2
    before = told.clone()
    known = digested({"spoken": told})["spoken"]
    assert torch.equal(told, before)  # what was given is left as it was
    for i in range(5):
        for j in range(7):
            assert torch.equal(known[i, j], digested({"spoken": told[i, j]})["spoken"])


@pytest.mark.parametrize("steps", [0, 1])
def test_one_step_is_as_it_was_told_and_no_steps_are_none(generator, steps):
    told = torch.rand(5, steps, 3, generator=generator) < 0.5
    assert torch.equal(digested({"spoken": told})["spoken"], told)


def test_digesting_again_changes_nothing(generator):
    """Planning gives models what was digested already, step by step."""
    known = digested({"spoken": torch.rand(9, STEPS, 3, generator=generator) < 0.2})
    assert torch.equal(digested(known)["spoken"], known["spoken"])


# --- what a person perceives ------------------------------------------------------------------


def blind(assumes_clear=1):
    values = dict.fromkeys(SIGHTS, BLIND) | {"assumes_clear": assumes_clear}
    return {name: torch.tensor([value]) for name, value in values.items()}


def far_away(steps):
    """Observations ``[1, T, ...]`` of a road with cars that nobody sees by themselves."""
    now = begun(0, [9, 8, -9, -8], [-1, -1, 1, 1]).now
    return {name: value.expand(1, steps, *value.shape).clone() for name, value in now.items()}


def perceived(assumes_clear=1, **told):
    nothing = torch.zeros(1, STEPS, 4, dtype=torch.bool)
    given = dict.fromkeys(NAMES, nothing) | told
    return human().perceive(blind(assumes_clear), far_away(STEPS), given)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("time", range(STEPS))
@pytest.mark.parametrize("car", range(4))
def test_what_is_told_stays_in_view(name, time, car):
    mask = told_at(*(time if index == car else None for index in range(4)))[None]
    view = perceived(**{name: mask})
    known = (torch.arange(STEPS) >= time)[:, None] & (torch.arange(4) == car)
    (other,) = set(NAMES) - {name}
    assert torch.equal(view.visible[name][0], known)
    assert not view.visible[other].any()
    # And it is no longer taken to be absent, whichever way it was told.
    assert torch.equal(view.absent["visual"][0], ~known)
    assert not perceived(0, **{name: mask}).absent["visual"].any()


@pytest.mark.parametrize("name", NAMES)
def test_beliefs_follow_a_car_that_was_told_of_once(name):
    """As if it were told of at each step; and not as if it were told of never, or later."""

    def believed(*steps):
        told = torch.zeros(1, STEPS, 4, dtype=torch.bool)
        told[0, list(steps), 0] = True
        done = torch.zeros(1, STEPS, dtype=torch.long)
        return human().believe(perceived(**{name: told}), far_away(STEPS), done)

    torch.testing.assert_close(believed(1), believed(1, 2, 3), rtol=0, atol=0)
    for others in ((), (2,)):
        assert (believed(1) - believed(*others))[0, 1:].abs().amax(-1).min() > 0.01


# --- planning step by step --------------------------------------------------------------------


def look(parent, past, message, action):
    """One look at the present of a round."""
    one = torch.zeros(1, dtype=torch.long)
    return Looks(
        parent=parent,
        eye=one,
        action=one + action,
        row=one,
        observation={name: value[None] for name, value in past.now.items()},
        told=CHANNELS.split(message[None]),
    )


def steps_of_planning(*messages):
    """What somebody blind was told, in flags, by beliefs after each of these messages."""
    past = begun(0, [9, 8, -9, -8], [-1, -1, 1, 1])
    beliefs, parent = StepwiseBeliefs.before(person(), past)
    result, action = [], len(DOMAIN.actions)
    for message in messages:
        beliefs, parent = beliefs.after(look(parent, past, message, action))
        action = 0
        result.append(CHANNELS.join(beliefs.told)[parent[0]].tolist())
    return result


@pytest.mark.parametrize("name", NAMES)
def test_planning_remembers_what_was_told(name):
    silence, rear, front = flags(), flags(**{name: ["rear-left"]}), flags(**{name: ["front-left"]})
    both = rear | front
    told = steps_of_planning(silence, rear, silence, front, silence)
    assert told == [each.tolist() for each in (silence, rear, rear, both, both)]


def test_planning_goes_on_from_what_was_told_in_the_round_so_far():
    past = begun(0, [9, 8, -9, -8], [-1, -1, 1, 1])
    message = flags(visual=["front-left"], verbal=["rear-right"])
    past = past.then(CHANNELS.split(message), 0, past.now)
    past = past.then(CHANNELS.split(flags()), 0, past.now)
    beliefs, parent = StepwiseBeliefs.before(person(), past)
    assert torch.equal(CHANNELS.join(beliefs.told)[parent[0]], message)
    after, which = beliefs.after(look(parent, past, flags(verbal=["front-right"]), 0))
    assert torch.equal(CHANNELS.join(after.told)[which[0]], message | flags(verbal=["front-right"]))
    assert after.unknown["visual"][which[0]].tolist() == [False, False, True, False]

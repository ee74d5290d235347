"""What observers learn of cars, worked out by hand; and that it is what the drivers remember."""

from dataclasses import fields, replace

import pytest
import torch
from example_course import perceived
from example_person import DOMAIN, human, self_model

from mirror_ppl.domains.driving import CAR_LANES, DrivingState
from mirror_ppl.domains.driving.knowledge import ROAD_END, CarKnowledge, assumed_cars
from mirror_ppl.domains.driving.people import Memory, in_sight, remember
from mirror_ppl.models import HumanModel
from mirror_ppl.models.implants import assumption_sites, sight_sites

BINS = len(DOMAIN.reach_bins)
SIGHTS, ASSUMED = sight_sites(DOMAIN), assumption_sites(DOMAIN)
NAMES = ("visual", "verbal")
AHEAD, BEHIND = 0, 2  # cars
FAR = (99, 99, -99, -99)


def at(*places, car=AHEAD, lane=0):
    """Observations of one car at these places, the others far off the road."""
    everyone = [[*FAR[:car], place, *FAR[car + 1 :]] for place in places]
    return [
        DOMAIN.observe(DrivingState(torch.tensor(lane), torch.tensor(cars), torch.ones(4)))
        for cars in everyone
    ]


def items(*cars):
    return torch.isin(torch.arange(4), torch.tensor(cars, dtype=torch.long))


def told(visual=(), verbal=()):
    return {"visual": items(*visual), "verbal": items(*verbal)}


SILENCE = told()


def within(cells):
    """What a person sees who sees so far in all directions; nothing from -1 on."""

    def sees(observation):
        near = observation["visual"][..., 0].abs() <= cells
        return {"visual": near, "verbal": torch.zeros_like(near)}

    return sees


def course(observations, messages=(), reach=-1):
    """Knowledge after each step of a person who sees so far and hears these messages."""
    sees, knowledge, result = within(reach), DOMAIN.nothing_known(), []
    for step, observation in enumerate(observations):
        message = messages[step] if step < len(messages) else SILENCE
        seen = sees(observation)
        visible = {name: seen[name] | message[name] for name in NAMES}
        knowledge = DOMAIN.learn(knowledge, observation, visible, sees)
        result.append(knowledge)
    return result


def of(knowledge, car=AHEAD):
    """(placed, known, position, speed) of one car; they have to know nothing of the others."""
    for part in fields(knowledge):
        others = getattr(knowledge, part.name)[~items(car)]
        assert not others.any(), part.name
    return tuple(getattr(knowledge, part.name)[car].item() for part in fields(knowledge))


def same(first, second):
    return all(torch.equal(getattr(first, p.name), getattr(second, p.name)) for p in fields(first))


KNOWN = (True, True, 0, 0)
NOTHING = (False, False, 0, 0)


def unsure(position, speed):
    return (True, False, position, speed)


# --- learn ------------------------------------------------------------------------------------


def test_at_the_beginning_nothing_is_known():
    knowledge = DOMAIN.nothing_known(2, 3)
    for part in fields(knowledge):
        value = getattr(knowledge, part.name)
        assert value.shape == (2, 3, 4) and not value.any()
    assert knowledge.placed.dtype == knowledge.known.dtype == torch.bool
    assert not knowledge.unsure.any()


@pytest.mark.parametrize(
    ("place", "speed"), [(5, -1), (1, -1), (11, -1), (0, 1), (-1, 1), (-5, 1), (-11, 1)]
)
@pytest.mark.parametrize("car", range(4))
def test_first_sight_gives_the_place_and_leaves_the_speed_to_be_assumed(car, place, speed):
    """Closer, that is; a car abreast would have been ahead before had it come from there."""
    steps = course(at(place, 7, 7, car=car), [told(visual=[car])])
    expected = [unsure(place + step * speed, speed) for step in range(3)]
    assert [of(knowledge, car) for knowledge in steps] == expected


@pytest.mark.parametrize("gap", range(1, 5))
@pytest.mark.parametrize("speed", [-1, 1])
def test_second_sight_makes_it_known_however_much_later(gap, speed):
    places = [5 + speed * step for step in range(6)]
    silent = [SILENCE] * (gap - 1)
    shown = told(visual=[AHEAD])
    steps = [of(each) for each in course(at(*places), [shown, *silent, shown])]
    assert steps[:gap] == [unsure(5 - step, -1) for step in range(gap)]
    assert steps[gap:] == [KNOWN] * (6 - gap)


@pytest.mark.parametrize("visual", [(), (BEHIND,)])
def test_utterance_makes_it_known_at_once(visual):
    message, shown = told(visual, [BEHIND]), told(visual=[BEHIND])
    places = at(-4, -5, -6, car=BEHIND)
    for before, first in (([], []), ([SILENCE], [NOTHING]), ([shown], [unsure(-4, 1)])):
        steps = [of(knowledge, BEHIND) for knowledge in course(places, [*before, message])]
        assert steps == [*first, *[KNOWN] * (3 - len(first))]


def test_seen_and_shown_at_one_step_is_one_sight():
    steps = course(at(2, 1, 0), [told(visual=[AHEAD])], reach=2)
    assert of(steps[0]) == unsure(2, -1)
    assert of(steps[1]) == KNOWN


def test_car_missed_where_it_should_be_in_sight_is_known():
    # Seen at 4 cells, it should be at 3 next if it came closer, and at 2 after that.
    for reach, missed in ((3, 1), (2, 2), (1, 3), (0, 4)):
        steps = course(at(4, 5, 6, 7, 8), [told(visual=[AHEAD])], reach)
        expected = [*[unsure(4 - step, -1) for step in range(missed)], *[KNOWN] * (5 - missed)]
        assert [of(knowledge) for knowledge in steps] == expected
    # Behind, it draws away as well, and to a person who sees nothing it is never missing.
    steps = course(at(-4, -5, -6, car=BEHIND), [told(visual=[BEHIND])], reach=2)
    assert [of(k, BEHIND) for k in steps] == [unsure(-4, 1), unsure(-3, 1), KNOWN]
    steps = course(at(-4, -5, -6, car=BEHIND), [told(visual=[BEHIND])])
    assert of(steps[-1], BEHIND) == unsure(-2, 1)


def test_car_is_missed_only_in_a_lane_from_which_it_should_be_in_sight():
    """Whether it should be in sight depends on the lane at that step, not at the first sight."""

    def own_lane(observation):
        near = (observation["visual"] == torch.tensor([4.0, 0.0])).all(-1)
        return {"visual": near, "verbal": torch.zeros_like(near)}

    for lane, expected in ((0, KNOWN), (1, unsure(4, -1))):
        knowledge = DOMAIN.learn(DOMAIN.nothing_known(), *at(5), told(visual=[AHEAD]), own_lane)
        knowledge = DOMAIN.learn(knowledge, *at(6, lane=lane), SILENCE, own_lane)
        assert of(knowledge) == expected


@pytest.mark.parametrize("reach", [-1, ROAD_END])
def test_car_assumed_beyond_the_end_of_the_road_is_not_missed(reach):
    """There nobody can see it, however far they see: places saturate at the end of the road."""
    # They are blind until it should have come from abreast to 11 cells ahead, and then look up.
    *_, before, knowledge = course(at(*[0] * 12), [told(visual=[AHEAD])])
    assert of(knowledge) == unsure(11, 1)
    for place, observation in zip((12, 13, 14), at(-12, -13, -14), strict=True):
        knowledge = DOMAIN.learn(knowledge, observation, SILENCE, within(reach))
        assert of(knowledge) == unsure(place, 1)
        imagined = DOMAIN.assume(knowledge, observation)[1]
        assert imagined["visual"][AHEAD].tolist() == [ROAD_END, 0]
        assert imagined["verbal"][AHEAD].tolist() == [ROAD_END, 0, 0]
    # A step earlier, on the road, it was missed.
    knowledge = DOMAIN.learn(before, *at(-11), SILENCE, within(reach))
    assert of(knowledge) == (unsure(11, 1) if reach < 0 else KNOWN)


# --- known, assume, supposed ------------------------------------------------------------------


def mixed(lane=0):
    """Four cars: one spoken of, one shown ahead, one shown behind, one never told of."""
    now = DrivingState(
        torch.tensor(lane), torch.tensor([5, 6, -7, -8]), torch.tensor([1, 1, -1, -1])
    )
    observation = DOMAIN.observe(now)
    message = told(visual=[1, 2], verbal=[0])
    knowledge = DOMAIN.learn(DOMAIN.nothing_known(), observation, message, within(-1))
    after = DOMAIN.transition(now, torch.tensor(0))
    return DOMAIN.learn(knowledge, DOMAIN.observe(after), SILENCE, within(-1)), after


def test_of_a_known_car_both_items_are_known_and_of_others_none():
    known = DOMAIN.known(mixed()[0])
    assert {name: mask.int().tolist() for name, mask in known.items()} == {
        "visual": [1, 0, 0, 0],
        "verbal": [1, 0, 0, 0],
    }


@pytest.mark.parametrize("lane", [0, 1])
def test_what_may_be_assumed_of_cars_that_are_not_known(lane):
    knowledge, after = mixed(lane)
    observation = DOMAIN.observe(after)
    kept = {name: value.clone() for name, value in observation.items()}
    about, imagined = DOMAIN.assume(knowledge, observation)
    assert tuple(about) == DOMAIN.assumptions == ("clear", "closing")
    absent, closer = [False, False, False, True], [False, True, True, False]
    for name, clear in (("visual", absent), ("verbal", [False] * 4)):
        assert about["clear"][name].tolist() == clear
        assert about["closing"][name].tolist() == closer
    # What is imagined of known cars means nothing.
    expected = [[5, 1 - lane, -1], [-6, -lane, 1], [ROAD_END, 1 - lane, 0]]
    assert imagined["verbal"][1:].tolist() == expected
    assert imagined["visual"][1:].tolist() == [place[:2] for place in expected]
    assert imagined["ego"].tolist() == [lane]
    assert all(torch.equal(observation[name], kept[name]) for name in kept)


def test_assumed_cars_are_what_there_would_be_to_observe(generator):
    lane = torch.randint(2, (300,), generator=generator)
    position = torch.randint(-15, 16, (300, 4), generator=generator)
    speed = torch.where(torch.rand(300, 4, generator=generator) < 0.5, -1, 1)
    expected = DOMAIN.observe(DrivingState(lane, position, speed))
    anything = DOMAIN.observe(replace(DOMAIN.initial(300, generator), lane=lane))
    found = assumed_cars(position.float(), speed.float(), anything)
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in expected)


@pytest.mark.parametrize("clear", [False, True])
@pytest.mark.parametrize("closing", [False, True])
def test_supposed_is_the_state_as_they_assume_it(clear, closing):
    knowledge, after = mixed()
    assumes = {"clear": torch.tensor(clear), "closing": torch.tensor(closing)}
    supposed = DOMAIN.supposed(after, knowledge, assumes)
    position, speed = after.position.tolist(), after.speed.tolist()
    if closing:
        position[1:3], speed[1:3] = [5, -6], [-1, 1]
    if clear:
        assert supposed.position[3] >= 10 * ROAD_END
        position[3] = supposed.position[3].item()
    assert supposed.position.tolist() == position
    assert supposed.speed.tolist() == speed
    assert supposed.lane == after.lane
    assert supposed.position.dtype == supposed.speed.dtype == torch.long


# --- random rounds ----------------------------------------------------------------------------


def random_rounds(number, generator, rate=0.05):
    """States and messages of each step ``[number]`` of rounds with random actions."""
    states, messages = [DOMAIN.initial(number, generator)], []
    for _ in range(DOMAIN.horizon + 1):
        allowed = DOMAIN.communicable(DOMAIN.observe(states[-1]))
        action_noise = {name: torch.rand(number, 4, generator=generator) < rate for name in NAMES}
        messages.append({name: allowed[name] & action_noise[name] for name in NAMES})
        action = torch.randint(2, (number,), generator=generator)
        states.append(DOMAIN.transition(states[-1], action))
    return states[:-1], messages


def eyes(reach):
    """What a person sees who sees so far ``[B, 4]`` in each direction."""

    def sees(observation):
        lane = observation["ego"][..., 0].long()
        seen = in_sight(reach, observation["visual"][..., 0], lane)
        return {"visual": seen, "verbal": torch.zeros_like(seen)}

    return sees


def learning(states, messages, reach):
    """Knowledge after each step of a round."""
    sees, knowledge = eyes(reach), DOMAIN.nothing_known(len(reach))
    for state, message in zip(states, messages, strict=True):
        observation = DOMAIN.observe(state)
        seen = sees(observation)
        visible = {name: seen[name] | message[name] for name in NAMES}
        knowledge = DOMAIN.learn(knowledge, observation, visible, sees)
        yield knowledge


def remembering(states, messages, reach):
    """The drivers' memory after each step of a round."""
    sees, memory = eyes(reach), Memory.empty((len(reach),))
    for state, message in zip(states, messages, strict=True):
        observation = DOMAIN.observe(state)
        memory = remember(memory, observation, sees(observation)["visual"], message, reach)
        yield memory


def random_reaches(number, generator):
    index = torch.randint(BINS, (number, 4), generator=generator)
    return index, torch.tensor(DOMAIN.reach_bins)[index]


def test_many_rounds_at_once_are_the_rounds_one_by_one(generator):
    states, messages = random_rounds(30, generator)
    _, reach = random_reaches(30, generator)
    together = list(learning(states, messages, reach))
    for row in range(30):
        own = [DrivingState(*(part[[row]] for part in vars(state).values())) for state in states]
        heard = [{name: mask[[row]] for name, mask in message.items()} for message in messages]
        alone = learning(own, heard, reach[[row]])
        for step, knowledge in enumerate(alone):
            whole = together[step]
            part = CarKnowledge(*(getattr(whole, p.name)[[row]] for p in fields(whole)))
            assert same(knowledge, part)


def on_road(position):
    return position.abs() < ROAD_END


def test_supposed_are_the_cars_that_the_drivers_remember(generator):
    number = 3000
    states, messages = random_rounds(number, generator)
    _, reach = random_reaches(number, generator)
    assumes = dict.fromkeys(DOMAIN.assumptions, torch.ones(number, dtype=torch.bool))
    assumed = wrong = 0
    both = zip(learning(states, messages, reach), remembering(states, messages, reach), strict=True)
    for state, (knowledge, memory) in zip(states, both, strict=True):
        supposed = DOMAIN.supposed(state, knowledge, assumes)
        here = memory.known & on_road(memory.position)
        assert torch.equal(supposed.position[here].float(), memory.position[here])
        assert torch.equal(supposed.speed[here].float(), memory.speed[here])
        assert torch.equal(knowledge.unsure[here], memory.assumed[here])
        # There are no others.
        assert torch.equal(on_road(supposed.position), here)
        assert torch.equal(knowledge.placed, memory.known)
        unsure = here & knowledge.unsure
        assumed += unsure.sum()
        wrong += (unsure & (supposed.position != state.position)).sum()
    # Not by knowing everything: thousands of times they are unsure, and often wrong.
    assert assumed > number and wrong > number / 5


# --- in the human model -----------------------------------------------------------------------


def stacked(states, messages):
    """Observations and messages of rounds ``[B, T, ...]``."""
    seen = [DOMAIN.observe(state) for state in states]
    observation = {name: torch.stack([now[name] for now in seen], 1) for name in seen[0]}
    return observation, {name: torch.stack([now[name] for now in messages], 1) for name in NAMES}


def implants(index):
    """Implants of people with these thresholds ``[B, 4]`` (indices) and every assumption."""
    values = dict(zip(SIGHTS, index.unbind(-1), strict=True))
    return values | dict.fromkeys(ASSUMED, torch.ones(len(index)))


def test_people_of_the_human_model_have_in_mind_what_drivers_remember(generator):
    """Place and speed of each car on the road, and that they see no more than they do."""
    number = 1000
    states, messages = random_rounds(number, generator)
    index, reach = random_reaches(number, generator)
    observation, heard = stacked(states, messages)
    view = perceived(human(), implants(index), observation, heard)
    lanes = torch.tensor(CAR_LANES)
    for step, memory in enumerate(remembering(states, messages, reach)):
        offset = (lanes - states[step].lane[:, None]).float()
        here = memory.known & on_road(memory.position)
        place = torch.stack([memory.position, offset], -1)
        whole = torch.cat([place, memory.speed[..., None]], -1)
        for name, expected in (("visual", place), ("verbal", whole)):
            visible, taken = view.visible[name][:, step], view.taken[name][:, step]
            real, imagined = observation[name][:, step], view.imagined[name][:, step]
            assert not (visible & taken).any()
            assert ((visible | taken) >= here).all()
            mind = torch.where(visible[..., None], real, imagined)
            assert torch.equal(mind[here], expected[here])
            # Of other cars: that they are not there, if anything.
            assert (mind[~here & (visible | taken)][:, 0].abs() == ROAD_END).all()


class Mirrors(HumanModel):
    """People who see what is behind them as far as what is ahead."""

    def sees(self, implants, observation, step):
        alike = {name: implants[name.replace("back", "front")] for name in SIGHTS}
        return super().sees(alike, observation, step)


def test_a_model_that_overrides_sees_notices_what_it_misses(generator):
    model = Mirrors(self_model())
    states, messages = random_rounds(40, generator, rate=0.1)
    observation, heard = stacked(states, messages)
    index, _ = random_reaches(40, generator)
    found = perceived(model, implants(index), observation, heard).numbers()
    alike = index[:, [SIGHTS.index(name.replace("back", "front")) for name in SIGHTS]]
    expected, other = (
        perceived(human(), implants(each), observation, heard).numbers() for each in (alike, index)
    )
    assert torch.equal(found, expected)
    assert not torch.equal(found, other)

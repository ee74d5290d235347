"""Simulated drivers: what they see, hear, remember and do; and the best messages to them."""

import pytest
import torch
from highway_states import state_of

from mirror_ppl.communication.messages import Channels
from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.highway import Highway
from mirror_ppl.domains.highway.knowledge import HEARD_AT, REMEMBERED
from mirror_ppl.domains.highway.manoeuvres import MANOEUVRES
from mirror_ppl.domains.highway.messages import GROUPS
from mirror_ppl.domains.highway.participants import best_messages, simulated_highway_drivers
from mirror_ppl.domains.highway.people import HighwayDrivers
from mirror_ppl.domains.highway.speech import DIRECTIONS
from mirror_ppl.errors import UnknownNameError

WORLD = Highway()
CHANNELS = Channels(WORLD)
FRONT, REAR = DIRECTIONS.index("front"), DIRECTIONS.index("rear")
CRAWLS = (28.0, 4.0, 0.0, 1.5)


def driver(*reach, consistency=5.0):
    one = torch.ones(1)
    return HighwayDrivers(torch.tensor([reach]), consistency * one, one)


def observed(*cars, ego=(0.0, 4.0, 0.0, 10.0)):
    """Observations of one person."""
    now = WORLD.observe(state_of(ego, cars, torch.float32))
    return {name: part[None] for name, part in now.items()}


def message(**items):
    flags = CHANNELS.flags({"visual": items.get("visual", ()), "verbal": items.get("verbal", ())})
    return CHANNELS.split(flags[None])


def test_sectors_are_seen_within_reach():
    now = observed((20.0, 4.0, 0.0, 9.0))  # 17.5 m to its rear
    for reach, expected in ((15.0, False), (20.0, True)):
        seen = driver(reach, 60.0, 60.0, 60.0).sees(now)
        assert seen["visual"][0, 0].item() is expected and not seen["verbal"].any()
        assert seen["visual"][0, list(GROUPS[1])].all()


def test_who_sees_a_crawling_car_makes_way_and_who_does_not_drives_on():
    def lane(*reach, told=None):
        probability, _ = driver(*reach).step(driver(*reach).start(), observed(CRAWLS), told)
        assert probability.sum().item() == pytest.approx(1)
        return MANOEUVRES[int(probability[0].argmax())]

    goes_on = "middle lane fast"
    assert lane(60.0, 60.0, 60.0, 60.0) != goes_on and lane(10.0, 10.0, 10.0, 10.0) == goes_on
    for told in (message(visual=["front"]), message(verbal=["front"])):
        assert lane(10.0, 10.0, 10.0, 10.0, told=told) != goes_on
    assert lane(10.0, 10.0, 10.0, 10.0, told=message(visual=["rear"])) == goes_on


def test_a_car_that_is_told_of_is_imagined():
    someone = driver(5.0, 5.0, 5.0, 5.0)
    _, memory = someone.step(someone.start(), observed(CRAWLS), message(verbal=["front"]))
    assert memory.there[0].nonzero().flatten().tolist() == [FRONT]
    assert memory.x[0, FRONT] == HEARD_AT[0] and memory.speed[0, FRONT] == 5.0
    _, memory = someone.step(memory, observed(), message(verbal=["front"]))
    assert not memory.there.any()  # who is told that nothing is there


def test_cars_out_of_sight_are_expected_to_drive_on_for_a_while():
    someone = driver(30.0, 30.0, 5.0, 5.0)
    behind = (-12.0, 4.0, 0.0, 8.0)
    _, memory = someone.step(someone.start(), observed(behind), message(visual=["rear"]))
    assert memory.there[0].nonzero().flatten().tolist() == [REAR]
    for step in range(1, REMEMBERED + 1):
        _, memory = someone.step(memory, observed())
        assert memory.there[0, REAR] and memory.age[0, REAR] == step
        # It falls back by a metre in half a second.
        assert memory.x[0, REAR].item() == pytest.approx(-12.0 - step, abs=0.1)
    _, memory = someone.step(memory, observed())
    assert not memory.there.any()


def test_who_looks_where_a_car_should_be_and_sees_none_forgets_it():
    someone = driver(30.0, 30.0, 5.0, 5.0)
    _, memory = someone.step(someone.start(), observed((20.0, 4.0, 0.0, 9.0)))
    assert memory.there[0, FRONT]
    _, memory = someone.step(memory, observed())
    assert not memory.there.any()


def test_people_of_a_batch_are_as_each_alone(generator):
    people = simulated_highway_drivers("fog", "diverse", 3, 1)
    states = WORLD.initial(3, generator)
    start = map_state(lambda part: part[:, None], states)
    probability, memory = people.step(people.start(1), WORLD.observe(start))
    own = people.select([2])
    alone, _ = own.step(own.start(1), WORLD.observe(map_state(lambda part: part[2:], start)))
    torch.testing.assert_close(probability[2:], alone)
    assert memory.x.shape == (3, 1, 6)


def test_a_seed_gives_the_same_people_and_populations_are_known_by_name():
    three, five = (simulated_highway_drivers("fog", "diverse", n, 1) for n in (3, 5))
    assert torch.equal(three.reach, five.reach[:3]) and torch.equal(three.caution, five.caution[:3])
    alike = simulated_highway_drivers("fog", "paper", 2, 1)
    assert alike.reach.tolist() == [[15.0, 15.0, 5.0, 5.0]] * 2
    assert set(three.truth()) == {*(f"sight_{name}" for name in WORLD.directions), "assumes_clear"}
    with pytest.raises(UnknownNameError, match="diverse, paper"):
        simulated_highway_drivers("fog", "nobody", 1, 1)


def test_the_best_message_is_about_what_is_not_seen_and_matters():
    blind = driver(10.0, 10.0, 10.0, 10.0)
    states = [state_of(cars=cars, dtype=torch.float32) for cars in ([CRAWLS], [])]
    state = map_state(lambda *parts: torch.stack(parts)[None], *states)
    flags = best_messages(blind, state, blind.start(2))
    assert flags.shape == (2, len(CHANNELS)) and not flags[1].any()
    chosen = {item for _, item in CHANNELS.message(flags[0])}
    assert "front" in chosen
    everything = driver(60.0, 60.0, 60.0, 60.0)
    assert not best_messages(everything, state, everything.start(2)).any()

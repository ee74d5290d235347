"""What people know of cars on the highway: in the human model as in simulated drivers."""

from dataclasses import fields

import pytest
import torch
from highway_states import state_of

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains.base import RepeatedObservation, by_eye
from mirror_ppl.domains.highway import Highway, expert
from mirror_ppl.domains.highway.knowledge import REMEMBERED, imagined, once_each
from mirror_ppl.domains.highway.lidar import RANGE
from mirror_ppl.domains.highway.participants import simulated_highway_drivers
from mirror_ppl.models.human import at_step
from mirror_ppl.models.implants import ASSUMES
from mirror_ppl.models.perception import perceived_by

WORLD = Highway()
EGO = (0.0, 4.0, 0.0, 10.0)
"""In the middle lane, at 10 m/s."""


def observed(*cars):
    now = WORLD.observe(state_of(EGO, cars, torch.float32))
    return {name: part[None] for name, part in now.items()}


def sees_within(*reach):
    def sees(observation):
        direction, distance = WORLD.distance(observation)
        return by_eye(WORLD, distance <= torch.tensor(reach)[direction])

    return sees


def nobody_speaks(observation):
    return {
        name: torch.zeros_like(value[..., 0], dtype=torch.bool)
        for name, value in observation.items()
        if name != "ego"
    }


def looked(knowledge, observation, sees, clear=1):
    """The view of a person who takes the road for clear, or not, and their knowledge."""
    assumes = {ASSUMES + "clear": torch.tensor([clear])}
    told = nobody_speaks(observation)
    return perceived_by(sees, WORLD, assumes, knowledge, observation, told)


def test_people_in_the_model_remember_as_simulated_drivers_do(monkeypatch):
    """Knowledge and memory hold the same cars, at the same places, in rounds of ten drivers."""
    plans = torch.zeros(10, 1, 12)  # which do not matter here
    monkeypatch.setattr(expert, "values", lambda state, weights: plans)
    recordings = load_demonstrations(asset_path("highway_fog_diverse.nc"))
    people = simulated_highway_drivers("fog", "diverse", len(recordings.people), 0)
    rounds = recordings.select_rounds([0])
    memory, knowledge = people.start(1), WORLD.nothing_known(len(recordings.people), 1)
    some = 0
    for step in range(24):
        now = at_step(rounds.observation(), step)
        told = nobody_speaks(now)
        visible = people.sees(now)
        knowledge = WORLD.learn(knowledge, now, visible, people.sees)
        _, memory = people.step(memory, now, told)
        assert torch.equal(knowledge.there, memory.there)
        for name in ("x", "y", "speed", "age"):
            ours, theirs = (getattr(one, name)[memory.there] for one in (knowledge, memory))
            assert torch.equal(ours, theirs)
        some += int((memory.age[memory.there] > 0).sum())
    assert some > 10  # cars that are remembered


@pytest.mark.parametrize(("rounds", "repeated"), [(1, False), (3, True), (3, False)])
def test_people_know_what_they_would_know_in_a_round_alone(rounds, repeated):
    """People whose rounds are observed together know what each would know alone."""
    recordings = load_demonstrations(asset_path("highway_fog_diverse.nc")).select_people([0])
    every = {name: value[0, [0] * rounds] for name, value in recordings.observation().items()}
    # The same sectors see cars in every round, each round's a little nearer than the one's before.
    distance = every["visual"][..., 0]
    nearer = 0.5 * torch.arange(rounds).view(-1, 1, 1)
    every["visual"][..., 0] = torch.where(distance < RANGE, distance - nearer, distance)
    row = torch.arange(rounds).repeat(2)
    reach = torch.tensor([10.0, 45.0]).repeat_interleave(rounds)

    def seen_by(people):
        return lambda now: by_eye(WORLD, now["visual"][..., 0] <= reach[people, None])

    everybody = torch.arange(len(row))
    together = WORLD.nothing_known(len(row))
    alone = [WORLD.nothing_known(1) for _ in everybody]
    for step in range(12):
        now = at_step(every, step)
        if repeated:
            now = RepeatedObservation(now, row)
        elif rounds > 1:
            now = {name: value[row] for name, value in now.items()}
        told = {name: mask[:1] for name, mask in nobody_speaks(now).items()}
        sees = seen_by(everybody)
        together = WORLD.learn(together, now, {**told, **sees(now)}, sees)
        for one in everybody.tolist():
            own, sees = at_step(every, step), seen_by([one])
            own = {name: value[row[one], None] for name, value in own.items()}
            alone[one] = WORLD.learn(alone[one], own, {**told, **sees(own)}, sees)
            for field in fields(together):
                many, single = (getattr(each, field.name) for each in (together, alone[one]))
                assert torch.equal(many.expand(len(row), -1)[one], single[0])
    assert len({tuple(x.tolist()) for x in together.x}) > rounds


def test_what_is_imagined_is_what_the_lidar_would_see_of_remembered_cars():
    sees = sees_within(30.0, 30.0, 5.0, 5.0)
    near, gone = (-7.0, 4.0, 0.0, 8.0), (-8.0, 4.0, 0.0, 8.0)  # 4.5 and 5.5 m to its front
    _, knowledge = looked(WORLD.nothing_known(1), observed(near), sees)
    view, knowledge = looked(knowledge, observed(gone), sees)
    # It is not seen any more, and expected a metre further back.
    assert not view.visible["visual"][0, 18] and view.taken["visual"][0, 18]
    expected = observed(gone)["visual"]
    torch.testing.assert_close(view.imagined["visual"], expected)
    for _ in range(REMEMBERED - 1):
        view, knowledge = looked(knowledge, observed(), sees)
        assert (view.imagined["visual"][..., 0] < RANGE).any()
    view, knowledge = looked(knowledge, observed(), sees)
    assert (view.imagined["visual"][..., 0] == RANGE).all()


def test_who_does_not_take_the_road_for_clear_imagines_nothing():
    sees = sees_within(5.0, 5.0, 5.0, 5.0)
    view, _ = looked(WORLD.nothing_known(1), observed((20.0, 4.0, 0.0, 9.0)), sees, clear=0)
    assert not view.taken["visual"].any()
    assert not view.visible["visual"].any()


def test_what_is_worked_out_once_for_equal_rows_is_right_for_each(generator):
    values = torch.randint(2, (50, 3), generator=generator).float()
    number = torch.arange(2.0).view(1, 2, 1)
    calls = []

    def function(one, other):
        calls.append(len(one))
        return one.sum(-1) + 10 * other[:, 0]

    found = once_each(function, (values[:, None], 1), (number, 1))
    torch.testing.assert_close(found, values.sum(-1)[:, None] + 10 * number[..., 0])
    assert calls == [len(values.unique(dim=0)) * 2]


def test_nothing_is_imagined_before_anything_was_seen():
    now = observed((20.0, 4.0, 0.0, 9.0))
    empty = imagined(WORLD.nothing_known(1), now)["visual"]
    assert empty[..., 0].eq(RANGE).all() and empty[..., 1:].eq(0).all()


@pytest.mark.parametrize("people", [1, 3])
def test_knowledge_has_the_shape_that_was_asked_for(people):
    assert WORLD.nothing_known(people, 4).x.shape == (people, 4, 6)
    known = WORLD.known(WORLD.nothing_known(people, 4))
    assert {name: mask.shape for name, mask in known.items()} == {
        "visual": (people, 4, 36),
        "verbal": (people, 4, 6),
    }
    assert not any(mask.any() for mask in known.values())

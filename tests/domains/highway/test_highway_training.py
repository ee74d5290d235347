"""What the robot learns from on the highway: rounds as others believe them, and in the mirror."""

from dataclasses import replace

import pytest
import torch
from highway_states import state_of

from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.checking import _faults_of_reflection
from mirror_ppl.domains.highway import Highway
from mirror_ppl.domains.highway.knowledge import nothing, remember
from mirror_ppl.domains.highway.manoeuvres import MANOEUVRES, REFLECTED
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import sizes_of
from mirror_ppl.training.experience import Course, experience
from mirror_ppl.training.self_model import _Trainer
from mirror_ppl.training.self_model_options import SelfModelOptions
from mirror_ppl.training.views import draw_views

WORLD = Highway()
STEPS = 12
SIGHT = (0.0, 0.0, 1.0)
"""Shares of views: limited sight only."""


@pytest.fixture(scope="module")
def course():
    generator = torch.Generator().manual_seed(0)
    start = WORLD.anywhere(12, generator)
    return Course.of(WORLD, start, torch.randint(12, (12, STEPS), generator=generator))


def test_left_and_right_are_exchanged_in_manoeuvres():
    for place, image in enumerate(REFLECTED):
        other = MANOEUVRES[place].replace("left", "LEFT").replace("right", "left")
        assert MANOEUVRES[image] == other.replace("LEFT", "right")


@pytest.mark.parametrize(
    ("name", "wrong", "fault"),
    [
        (
            "reflected_actions",
            (),
            "reflected_actions: expected the mirror image of each of 12, fou",
        ),
        ("reflected_items", {}, "reflected_items: visual: expected the mirror image of each of 36"),
        ("reflected", lambda self, state: replace(state, y=state.y - 1), "reflected: ego of the m"),
    ],
)
def test_faults_of_reflection_are_found(course, monkeypatch, name, wrong, fault):
    assert not _faults_of_reflection(WORLD, course.states, course.observation)
    monkeypatch.setattr(Highway, name, wrong)
    found = _faults_of_reflection(WORLD, course.states, course.observation)
    assert any(one.startswith(fault) for one in found)


def test_the_reflected_world_is_the_same_world(course):
    """States, rewards and the planner's values of reflected rounds are those of the rounds."""
    start = map_state(lambda part: part[:, 0], course.states)
    image = torch.tensor(WORLD.reflected_actions)
    found = Course.of(WORLD, WORLD.reflected(start), image[course.actions])
    values = WORLD.reference_values(start, 1.0)
    reflected = replace(course, values=values[:, None].expand(-1, STEPS, -1)).reflected(WORLD)
    for name, value in found.observation.items():
        torch.testing.assert_close(reflected.observation[name], value, rtol=0, atol=1 / 16)
        if name != "ego":
            there = course.observation[name][:, :, WORLD.reflected_items[name], 0]
            torch.testing.assert_close(value[..., 0], there, rtol=0, atol=1 / 16)
    torch.testing.assert_close(found.rewards, course.rewards, rtol=0, atol=1e-3)
    torch.testing.assert_close(
        WORLD.reference_values(WORLD.reflected(start), 1.0),
        reflected.values[:, 0],
        rtol=0,
        atol=0.05,
    )
    assert torch.equal(reflected.actions, found.actions)
    twice = reflected.reflected(WORLD)
    assert torch.equal(twice.actions, course.actions)
    torch.testing.assert_close(twice.states.y, course.states.y)


def test_rounds_are_kept_as_they_are_believed(course, generator):
    """Who takes the road for clear believes in the known cars alone; other rounds stay true."""
    plan = draw_views(WORLD, 12, STEPS, generator, SIGHT, 0.5)
    plan = replace(plan, told={name: torch.ones(12) for name in plan.told})
    assuming = plan.assumes["clear"]
    assert 0 < assuming.sum() < 12
    believed = course.supposed_by(WORLD, plan)
    for name, value in believed.observation.items():
        assert torch.equal(value[~assuming], course.observation[name][~assuming])
    assert torch.equal(believed.rewards[~assuming], course.rewards[~assuming])
    assert torch.equal(believed.believed, assuming)
    assert believed.taken["visual"][assuming].all()
    assert torch.equal(
        believed.taken["verbal"][assuming],
        WORLD.communicable(course.observation)["verbal"][assuming],
    )
    memory = nothing(12, 1, like=course.rewards)
    for step in range(STEPS + 1):
        now = {name: value[:, step : step + 1] for name, value in course.observation.items()}
        visible = plan.visibility(WORLD, now, step)

        def sees(observation, step=step):
            return plan.sees(WORLD, observation, step)

        memory = WORLD.learn(memory, now, visible, sees)
        there = believed.states.x[:, step, 1:7].abs() < 100
        assert torch.equal(there[assuming], memory.there[assuming, 0])


def test_what_was_believed_is_seen_whatever_the_view(course, generator):
    plan = draw_views(WORLD, 12, STEPS, generator, SIGHT, 0.5)
    believed = course.supposed_by(WORLD, plan)
    blind = draw_views(WORLD, 12, STEPS, generator, SIGHT, 0.0)
    blind = replace(blind, reach=torch.zeros_like(blind.reach))
    assuming = plan.assumes["clear"]
    lived = experience(WORLD, replace(believed, values=torch.zeros(12, STEPS, 12)), blind)
    assert torch.equal(lived.rounds.visible["visual"].flatten(1).all(1), assuming), (
        "sectors of believed rounds are seen, those of others are not"
    )
    assert torch.equal(lived.informed, assuming[:, None].expand(-1, STEPS))
    both = Course.join([believed, believed.reflected(WORLD)])
    part = both.window(torch.tensor([0, 12]), 3, 4)
    assert len(both.actions) == 24 and part.taken["visual"].shape == (2, 5, 36)
    first, second = part.taken["verbal"]
    assert torch.equal(first[:, WORLD.reflected_items["verbal"]], second)


def test_the_robot_learns_from_mirror_images_too():
    options = SelfModelOptions.of("highway", rounds=4, beta=0.0, length=STEPS, window=4, stride=4)
    generator = torch.Generator().manual_seed(0)
    robot = sizes_of(WORLD)
    trainer = _Trainer(WORLD, options, generator, 0, "words", robot, SelfModel)
    trainer._drive()
    course = trainer._course()
    image = list(REFLECTED)
    assert len(course.actions) == len(course.believed) == 8
    assert torch.equal(course.values[4:, ::4], course.values[:4, ::4][..., image])
    torch.testing.assert_close(course.states.heading[4:], -course.states.heading[:4])


def test_knowledge_is_followed_only_where_something_depends_on_it(course, generator, monkeypatch):
    """Where everything moves, only assumptions depend on knowledge."""

    def fails(*args):
        raise AssertionError

    monkeypatch.setattr(Highway, "learn", fails)
    course = replace(course, values=torch.zeros(12, STEPS, 12))
    experience(WORLD, course, draw_views(WORLD, 12, STEPS, generator, SIGHT, 0.0))
    with pytest.raises(AssertionError):
        experience(WORLD, course, draw_views(WORLD, 12, STEPS, generator, SIGHT, 1.0))


def test_messages_of_the_mirror_image_are_about_the_mirror_image():
    """A car ahead on the right is one ahead on the left there."""
    state = state_of((0.0, 4.0, 0.0, 10.0), [(20.0, 8.0, 0.0, 8.0)], torch.float32)
    for now in (state, WORLD.reflected(state)):
        observation = WORLD.observe(now)
        nobody = torch.zeros(36, dtype=torch.bool)
        heard = torch.ones(6, dtype=torch.bool)
        memory = remember(
            nothing(like=now.x), observation, nobody, heard, lambda distance: distance >= 0
        )
        side = 1 if now is state else 5
        assert memory.there.nonzero().flatten().tolist() == [side]

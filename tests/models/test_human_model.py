"""The human model: what people perceive, and what they believe of it."""

from dataclasses import replace

import pytest
import torch
from example_course import beliefs_of, perceived
from example_implants import (
    ASSUMED,
    DRIVING,
    LATENT,
    SIGHTS,
    STEPS,
    first_round,
    nothing_told,
    sight,
)

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains.driving import ROAD_END, DrivingState
from mirror_ppl.models import HumanModel, View
from mirror_ppl.models.weights import load_self_model, shipped_weights

BINS = DRIVING.reach_bins


@pytest.fixture(scope="module")
def human():
    return HumanModel(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def recordings():
    """Two people in fog, two rounds each."""
    every = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return every.select_people([0, 3]).select_rounds(slice(0, 2))


# --- perceive, by hand ------------------------------------------------------------------------


def looked_at(positions, lane=0):
    """Observations ``[1, T, ...]`` of cars at these positions ``[T][4]``."""
    position = torch.tensor(positions)
    state = DrivingState(torch.full((len(positions),), lane), position, torch.ones_like(position))
    return {name: value[None] for name, value in DRIVING.observe(state).items()}


# Front-left, front-right, rear-left, rear-right; which direction each is in from either lane.
DIRECTIONS = {
    0: ("front_own", "front_other", "back_own", "back_other"),
    1: ("front_other", "front_own", "back_other", "back_own"),
}


@pytest.mark.parametrize("lane", [0, 1])
@pytest.mark.parametrize("car", range(4))
def test_threshold_of_its_direction_decides_at_every_edge(human, lane, car):
    side = 1 if car < 2 else -1
    distances = list(range(0 if side > 0 else 1, ROAD_END + 1))  # abreast counts as ahead
    far = [ROAD_END, ROAD_END, -ROAD_END, -ROAD_END]
    positions = [[*far[:car], side * distance, *far[car + 1 :]] for distance in distances]
    # One look at each distance.
    observation = {name: value[0] for name, value in looked_at(positions, lane).items()}
    direction = DIRECTIONS[lane][car]
    for index, edge in enumerate(BINS):
        seen = human.sees(sight(**{direction: index}), observation, 0)
        expected = [distance <= edge for distance in distances]
        assert seen["visual"][:, car].tolist() == expected
        assert not seen["verbal"].any()
        # No other threshold matters to it.
        others = {name: 6 for name in DRIVING.directions if name != direction}
        implants = sight(**others, **{direction: index})
        assert human.sees(implants, observation, 0)["visual"][:, car].tolist() == expected
        # Each look the first of a round: a car seen twice would be known wherever it is then.
        rounds = {name: value[:, None] for name, value in observation.items()}
        view = perceived(human, implants, rounds, nothing_told(1))
        assert view.visible["visual"][:, 0, car].tolist() == expected
        assert not view.visible["verbal"].any()


def test_many_people_perceive_at_once_as_they_do_alone(human, recordings):
    implants = {site: torch.randint(len(BINS), (7,)) for site in SIGHTS}
    implants |= {site: torch.randint(2, (7,)) for site in ASSUMED}
    observation = {name: value[:1, 0, :STEPS] for name, value in recordings.observation().items()}
    told = {name: torch.rand(1, STEPS, 4) < 0.1 for name in ("visual", "verbal")}
    together = perceived(human, implants, observation, told)
    assert all(mask.any() for mask in together.taken.values())
    for row in range(7):
        own = {site: value[row : row + 1] for site, value in implants.items()}
        alone = perceived(human, own, observation, told)
        assert torch.equal(together.numbers()[row], alone.numbers()[0])
        for name in told:
            assert torch.equal(together.visible[name][row], alone.visible[name][0])
            assert torch.equal(together.taken[name][row], alone.taken[name][0])
            assert torch.equal(together.imagined[name][row], alone.imagined[name][0])


def test_messages_are_overlaid_on_sight(human):
    observation = looked_at([[5, 9, -3, -4]] * 3)
    told = nothing_told(3)
    told["visual"][0, 1, 0] = True
    told["verbal"][0, 2, 3] = True
    view = perceived(human, sight(back_own=3), observation, told)
    # The car behind is seen, and from the second time on known; one ahead is shown at step 1;
    # another is spoken of at step 2.
    expected = [
        [False, False, True, False],
        [True, False, True, False],
        [False, False, True, True],
    ]
    assert view.visible["visual"][0].tolist() == expected
    expected = [[False] * 4, [False, False, True, False], [False, False, True, True]]
    assert view.visible["verbal"][0].tolist() == expected
    assert not any(mask.any() for mask in view.taken.values())


def test_absent_is_what_was_never_seen_nor_communicated(human):
    # Seen at one step, spoken of at one, seen always, never.
    observation = looked_at([[3, 9, -1, -4], [2, 9, -1, -4], [3, 9, -1, -4]])
    told = nothing_told(3)
    told["verbal"][0, 1, 1] = True
    view = perceived(human, sight(1, front_own=2, back_own=1), observation, told)
    assert view.taken["visual"][0].tolist() == [
        [True, True, False, True],
        [False, False, False, True],
        [False, False, False, True],
    ]
    assert not view.taken["verbal"].any()
    assert (view.imagined["visual"][..., 0][view.taken["visual"]] == ROAD_END).all()
    view = perceived(human, sight(0, front_own=2, back_own=1), observation, told)
    assert not any(mask.any() for mask in view.taken.values())


def test_a_car_seen_once_comes_closer_until_they_know_better(human):
    # Shown at step 0 only; in truth it draws away. From two cells on they would see it.
    observation = looked_at([[5, 9, -9, -9], [6, 9, -9, -9], [7, 9, -9, -9], [8, 9, -9, -9]])
    told = nothing_told(4)
    told["visual"][0, 0, 0] = True
    view = perceived(human, sight(closing=1, front_own=3), observation, told)
    assert view.visible["visual"][0, :, 0].tolist() == [True, False, True, True]
    assert view.visible["verbal"][0, :, 0].tolist() == [False, False, True, True]
    assert view.taken["visual"][0, :, 0].tolist() == [False, True, False, False]
    assert view.taken["verbal"][0, :, 0].tolist() == [True, True, False, False]
    assert view.imagined["visual"][0, :2, 0].tolist() == [[5, 0], [4, 0]]
    assert view.imagined["verbal"][0, :2, 0].tolist() == [[5, 0, -1], [4, 0, -1]]
    # Whoever sees less far goes on believing it, and others take nothing for granted.
    view = perceived(human, sight(closing=1, front_own=1), observation, told)
    assert view.taken["visual"][0, :, 0].tolist() == [False, True, True, True]
    assert view.imagined["visual"][0, :, 0, 0].tolist() == [5, 4, 3, 2]
    view = perceived(human, sight(closing=0, front_own=1), observation, told)
    assert not any(mask.any() for mask in view.taken.values())


def test_each_car_is_taken_as_what_is_known_of_it_allows(human):
    # All draw away: one shown ahead, one behind, one spoken of, one never. They see three cells.
    observation = looked_at([[5, -5, 4, 9], [6, -6, 5, 9], [7, -7, 6, 9], [8, -8, 7, 9]])
    told = nothing_told(4)
    told["visual"][0, 0, :2] = True
    told["verbal"][0, 0, 2] = True
    for clear in (0, 1):
        view = perceived(human, sight(clear, 1, front_own=3, front_other=3), observation, told)
        # From 5 cells ahead it would be at 3 cells at step 2, and in sight; it is not.
        visual = [[0, 0, 0, clear], [1, 1, 0, clear], *[[0, 1, 0, clear]] * 2]
        assert view.taken["visual"][0].int().tolist() == visual
        # Of the speed not even the first sight tells.
        verbal = [*[[1, 1, 0, 0]] * 2, *[[0, 1, 0, 0]] * 2]
        assert view.taken["verbal"][0].int().tolist() == verbal
        assert view.imagined["verbal"][0, :, 1].tolist() == [[-5 + t, 1, 1] for t in range(4)]
        assert view.visible["visual"][0].int().tolist() == [
            [1, 1, 1, 0],
            [0, 0, 1, 0],
            [1, 0, 1, 0],
            [1, 0, 1, 0],
        ]
        assert view.visible["verbal"][0].int().tolist() == [
            *[[0, 0, 1, 0]] * 2,
            *[[1, 0, 1, 0]] * 2,
        ]


def test_numbers_of_views_are_equal_where_views_are(human, recordings):
    observation, _ = first_round(recordings)
    told = {name: torch.rand(1, STEPS, 4) < 0.1 for name in ("visual", "verbal")}
    view = perceived(human, sight(1, 1, front_own=3, back_other=2), observation, told)
    numbers = view.numbers()
    for name, mask in view.taken.items():
        assert mask.any() and not mask.all()
        value = view.imagined[name]
        # Of what is not taken, and of the ego, it does not matter what was imagined.
        other = torch.where(mask[..., None], value, value + 1)
        imagined = view.imagined | {name: other, "ego": 1 - view.imagined["ego"]}
        assert torch.equal(View(view.visible, view.taken, imagined).numbers(), numbers)
        for feature in range(value.shape[-1]):
            other = value.clone()
            other[..., feature] += 0.5
            changed = View(view.visible, view.taken, view.imagined | {name: other})
            assert torch.equal(changed.numbers() != numbers, mask.any(-1))
    for group in ("visible", "taken"):
        masks = getattr(view, group)
        for name, mask in masks.items():
            changed = replace(view, **{group: {**masks, name: ~mask}})
            assert (changed.numbers() != numbers).all()


def test_numbers_of_views_do_not_depend_on_how_many_items_are_taken(generator):
    """One view has one number among views that take few items for granted, and among others."""
    share = torch.tensor([0.1, 0.9]).repeat_interleave(50)[:, None]
    taken = torch.rand(100, 6, generator=generator) < share
    values = torch.rand(100, 6, 3, generator=generator)

    def numbers(rows, imagined=values):
        view = View({"visual": ~taken}, {"visual": taken}, {"visual": imagined})
        return view.map(lambda part: part[rows]).numbers()

    few, many = range(50), range(50, 100)
    assert torch.equal(numbers(range(100)), torch.cat([numbers(few), numbers(many)]))
    # The last row among few, and the first among many.
    assert torch.equal(numbers([*few, 99])[-1:], numbers([99]))
    assert torch.equal(numbers([0, *many])[:1], numbers([0]))
    for rows in (few, many):
        for feature in range(3):
            other = values.clone()
            other[:, 2, feature] += 0.5
            assert torch.equal(numbers(rows, other) != numbers(rows), taken[rows, 2])


def test_steps_by_hand_are_those_of_the_round(human, recordings):
    implants = {site: torch.randint(len(BINS), (7,)) for site in SIGHTS}
    implants |= {site: torch.randint(2, (7,)) for site in ASSUMED}
    observation = {name: value[:1, 0, :STEPS] for name, value in recordings.observation().items()}
    told = {name: torch.rand(1, STEPS, 4) < 0.1 for name in ("visual", "verbal")}
    view = perceived(human, implants, observation, told)
    assert torch.equal(view.imagined["ego"], observation["ego"])
    whole = view.numbers()
    knowledge = DRIVING.nothing_known(1)
    for step in range(STEPS):
        now = {name: value[:, step] for name, value in observation.items()}
        heard = {name: mask[:, step] for name, mask in told.items()}
        view, knowledge = human.perceive(implants, knowledge, now, heard, step)
        assert torch.equal(view.numbers(), whole[:, step])


def test_a_model_may_say_what_is_visible_and_no_more(human, recordings):
    class Attentive(HumanModel):
        """They see every other car, whatever the distance."""

        def sees(self, implants, observation, step):
            seen = super().sees(implants, observation, step)
            return seen | {"visual": (torch.arange(4) % 2 == 0).expand(seen["visual"].shape)}

    observation, actions = first_round(recordings)
    model = Attentive(human.self_model)
    view = perceived(model, sight(), observation, nothing_told(STEPS))
    assert view.visible["visual"][0].all(0).tolist() == [True, False, True, False]
    bare = View(view.visible)
    torch.testing.assert_close(
        beliefs_of(model, bare, observation, actions), beliefs_of(model, view, observation, actions)
    )


# --- believe ----------------------------------------------------------------------------------


def emptied(observation):
    """The observation with an empty road: every car beyond its visible end."""
    empty = {name: value.clone() for name, value in observation.items()}
    for name in ("visual", "verbal"):
        empty[name][..., 0] = ROAD_END
    empty["verbal"][..., 2] = 0.0
    return empty


def view_of(visible, absent=None, observation=None):
    """A view ``[1, T, 4]`` with nothing said, and some cars taken to be absent."""
    nothing = torch.zeros_like(visible)
    seen = {"visual": visible, "verbal": nothing}
    if absent is None:
        return View(seen)
    return View(seen, {"visual": absent, "verbal": nothing}, emptied(observation))


def test_belief_in_full_view_is_that_of_the_robot(human, recordings):
    observation, actions = first_round(recordings)
    for share in (1.0, 0.5):
        masks = {name: torch.rand(1, STEPS, 4) < share for name in ("visual", "verbal")}
        model = human.self_model
        expected = model.believe(model.evidence(observation, masks, actions[:, :-1]))
        nothing = {name: torch.zeros_like(mask) for name, mask in masks.items()}
        # Whether nothing is said of what is taken for granted, or that nothing is.
        for view in (View(masks), View(masks, nothing, emptied(observation))):
            belief = beliefs_of(human, view, observation, actions)
            torch.testing.assert_close(belief, expected)
    assert belief.shape == (1, STEPS, LATENT)


def test_assuming_absence_is_like_seeing_an_empty_road(human, recordings):
    observation, actions = first_round(recordings)
    everything = torch.ones(1, STEPS, 4, dtype=torch.bool)
    belief = beliefs_of(human, view_of(~everything, everything, observation), observation, actions)
    empty = emptied(observation)
    torch.testing.assert_close(belief, beliefs_of(human, view_of(everything), empty, actions))
    # One car seen and the others taken to be absent: like seeing a road with one car.
    only = everything & (torch.arange(4) == 1)
    mixed = {name: value.clone() for name, value in empty.items()}
    mixed["visual"][..., 1, :] = observation["visual"][..., 1, :]
    belief = beliefs_of(human, view_of(only, ~only, observation), observation, actions)
    torch.testing.assert_close(belief, beliefs_of(human, view_of(everything), mixed, actions))
    # And not like knowing nothing of them.
    unknown = beliefs_of(human, view_of(only), observation, actions)
    assert (unknown - belief).abs().max() > 0.1


def test_what_is_imagined_is_believed_like_what_is_seen_and_said(human, recordings):
    observation, actions = first_round(recordings)
    lane = observation["ego"][..., 0].long()
    speed = torch.where(torch.rand(1, STEPS, 4) < 0.5, -1, 1)
    imagined = DRIVING.observe(DrivingState(lane, torch.randint(-11, 12, (1, STEPS, 4)), speed))
    taken = {name: torch.rand(1, STEPS, 4) < 0.5 for name in ("visual", "verbal")}
    visible = {name: (torch.rand(1, STEPS, 4) < 0.5) & ~mask for name, mask in taken.items()}
    belief = beliefs_of(human, View(visible, taken, imagined), observation, actions)
    mixed = {"ego": observation["ego"]} | {
        name: torch.where(mask[..., None], imagined[name], observation[name])
        for name, mask in taken.items()
    }
    both = View({name: visible[name] | mask for name, mask in taken.items()})
    torch.testing.assert_close(belief, beliefs_of(human, both, mixed, actions))
    # Where they are themselves, people do not imagine.
    imagined["ego"] = 1 - imagined["ego"]
    same = beliefs_of(human, View(visible, taken, imagined), observation, actions)
    assert torch.equal(same, belief)


def test_masks_of_every_step_are_used(human, recordings):
    # The released MIRROR code applied the mask of the first frame to all of them.
    observation, actions = first_round(recordings)
    everything = torch.ones(1, STEPS, 4, dtype=torch.bool)
    full = beliefs_of(human, view_of(everything), observation, actions)
    for step in range(STEPS):
        less = everything.clone()
        less[:, step] = False
        belief = beliefs_of(human, view_of(less), observation, actions)
        assert torch.equal(belief[:, :step], full[:, :step])
        assert (belief[:, step:] != full[:, step:]).any(-1).all()
        absent = beliefs_of(human, view_of(less, ~less, observation), observation, actions)
        assert torch.equal(absent[:, :step], full[:, :step])
        assert not torch.equal(absent[:, step], belief[:, step])


@pytest.mark.parametrize("name", ["visual", "verbal"])
@pytest.mark.parametrize("clear", [0, 1])
@pytest.mark.parametrize("closing", [0, 1])
def test_a_message_counts_from_its_step_on(human, recordings, name, clear, closing):
    observation, actions = first_round(recordings)
    implants = sight(clear, closing)
    quiet = perceived(human, implants, observation, nothing_told(STEPS))
    before = beliefs_of(human, quiet, observation, actions)
    for step in (0, 6, STEPS - 1):
        told = nothing_told(STEPS)
        told[name][0, step, 2] = True
        view = perceived(human, implants, observation, told)
        belief = beliefs_of(human, view, observation, actions)
        assert torch.equal(belief[:, :step], before[:, :step])
        assert (belief[:, step:] != before[:, step:]).any(-1).all()


def test_belief_reads_the_action_before_it_and_never_the_last(human, recordings):
    observation, actions = first_round(recordings)
    view = view_of(torch.ones(1, STEPS, 4, dtype=torch.bool))
    full = beliefs_of(human, view, observation, actions)
    for step in range(STEPS):
        other = actions.clone()
        other[:, step] = 1 - other[:, step]
        belief = beliefs_of(human, view, observation, other)
        assert torch.equal(belief[:, : step + 1], full[:, : step + 1])
        assert (belief[:, step + 1 :] != full[:, step + 1 :]).any(-1).all()

"""What there is to see, show and say in search and rescue."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from example_rescue import LEFT, NINE, WORLD, alone, reachable, start

from mirror_ppl.domains.search_rescue import UTTERANCES
from mirror_ppl.domains.search_rescue.house import (
    HOUSE,
    OBSTACLES,
    PORTIONS,
    VICTIM,
    as_image,
    as_portions,
)
from mirror_ppl.errors import UnknownNameError


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


def test_networks_read_pixels_and_places():
    symbols = WORLD.symbols(WORLD.observe(start(NINE)))
    for name, size in WORLD.symbol_sizes.items():
        assert symbols[name].shape[-1] == size
    assert symbols["ego"][0].nonzero().flatten().tolist() == [8, 9 + 4]
    assert symbols["verbal"].sum(-1).tolist() == [[1.0] * 5] * 9

"""Groups of sectors, and what messages cost."""

import pytest
import torch
from highway_states import state_of

from mirror_ppl.communication import RoundSoFar, rules
from mirror_ppl.communication.messages import Channels
from mirror_ppl.domains import Modality, World
from mirror_ppl.domains.highway import Highway
from mirror_ppl.domains.highway.lidar import SECTORS
from mirror_ppl.domains.highway.messages import GROUPS, SEEN, SPOKEN, group_of
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.evaluation.played import Tally

CHANNELS = Channels(Highway())


def test_groups_part_the_sectors_and_are_mirrored():
    assert sorted(sector for group in GROUPS for sector in group) == list(range(SECTORS))
    mirror = [sorted(-sector % SECTORS for sector in group) for group in GROUPS]
    left_for_right = (0, 5, 4, 3, 2, 1)
    assert mirror == [sorted(GROUPS[each]) for each in left_for_right]
    assert 0 in GROUPS[0] and 18 in GROUPS[3]
    assert all(sector in GROUPS[group_of(sector)] for sector in range(SECTORS))


def test_a_message_shows_all_sectors_of_its_groups():
    flags = torch.zeros(2, len(CHANNELS), dtype=torch.bool)
    flags[1, [0, 3]] = True
    shown = CHANNELS.split(flags)["visual"]
    assert not shown[0].any()
    assert shown[1].nonzero()[:, 0].tolist() == sorted(GROUPS[0] + GROUPS[3])


def test_a_group_is_communicated_if_all_its_sectors_are():
    flags = torch.zeros(len(CHANNELS), dtype=torch.bool)
    flags[[1, 9]] = True
    masks = CHANNELS.split(flags)
    assert torch.equal(CHANNELS.join(masks), flags)
    masks["visual"][GROUPS[1][0]] = False
    assert CHANNELS.join(masks).nonzero().squeeze(-1).tolist() == [9]


def test_flags_of_items_are_those_of_their_groups():
    assert CHANNELS.flag_of("visual", 18) == 3 and CHANNELS.flag_of("verbal", 2) == 8
    assert CHANNELS.pairs[3] == ("visual", "rear") and CHANNELS.pairs[8] == ("verbal", "rear-right")
    with pytest.raises(UnknownNameError, match="verbal, visual"):
        CHANNELS.flag_of("touch", 0)


@pytest.mark.parametrize(
    ("shown", "said", "expected"),
    [(0, 0, 0.0), (1, 0, 0.01), (3, 0, 0.09), (0, 2, 0.12), (2, 1, 0.07)],
)
def test_costs_are_those_of_driving_in_table_i(shown, said, expected):
    items = torch.arange(6)
    assert CHANNELS.cost(torch.cat([items < shown, items < said])).item() == pytest.approx(expected)


def test_modalities_name_what_there_is():
    assert len(SEEN.items) == SECTORS and len(set(SEEN.items)) == SECTORS
    assert SEEN.communicated == SPOKEN.communicated == SPOKEN.items and len(SPOKEN.items) == 6


# --- rules by hand -------------------------------------------------------------------------------


def begun(*cars):
    world = Highway()
    now = world.observe(state_of(cars=cars, dtype=torch.float32))
    return RoundSoFar.begin(world, now)


def test_the_nearest_hidden_car_is_shown_with_its_group():
    """15 m ahead are seen in fog, 5 m behind; of two hidden cars the one behind is nearer."""
    near, far = (-14.0, 4.0, 0.0, 10.0), (25.0, 4.0, 0.0, 10.0)
    for cars, spoken in (((far, near), "rear"), ((far,), "front")):
        flags = rules.nearest(Highway(), begun(*cars), "fog")
        assert list(CHANNELS.message(flags)) == [("visual", spoken)]
    assert not rules.nearest(Highway(), begun((12.0, 4.0, 0.0, 10.0)), "fog").any()


def test_groups_are_described_and_counted_as_one():
    class TwoByTwo(World):
        modalities = (
            Modality("visual", ("a", "b", "c"), ("size",), ("m",), (1.0,), 0.1,
                     groups=(("both", (0, 1)), ("last", (2,)))),
        )  # fmt: skip
        ego_features, actions, horizon = ("here",), ("go", "stop"), 2

        def initial(self, batch, generator, scenario=None):
            raise NotImplementedError

        transition = rewards = observe = state_behind = initial

    seen = {"visual": torch.tensor([[1.0], [2.0], [3.0]])}
    world = TwoByTwo()
    assert world.describe(seen, "visual", "both") == "both (a: size 1 m; b: size 2 m)"
    assert world.describe(seen, "visual", "c") == "c: size 3 m"
    tally = Tally(Highway(), CHANNELS, 1)
    now = {name: part[None] for name, part in begun().now.items()}
    tally.add_messages(now, torch.eye(12, dtype=torch.bool)[:1], torch.tensor([True]))
    assert {name: count.tolist() for name, count in tally.items.items()} == {
        "visual": [1], "verbal": [0],
    }  # fmt: skip
    assert tally.communicable == {"visual": 6, "verbal": 6}


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ((("one", (0, 1)),), "each item belongs in exactly one group"),
        ((("one", (0, 1)), ("two", (1, 2))), "each item belongs in exactly one group"),
        ((("one", (0, 1)), ("one", (2,))), "groups need different names"),
    ],
)
def test_impossible_groups_are_refused(groups, message):
    with pytest.raises(ValueError, match=message):
        Modality("visual", ("a", "b", "c"), ("size",), ("m",), (1.0,), 0.1, groups=groups)


def test_random_messages_are_of_groups():
    generator = torch.Generator().manual_seed(0)
    flags = rules.at_random(Highway(), begun(), {"visual": 1.0, "verbal": 0.0}, generator)
    assert flags.tolist() == [True] * 6 + [False] * 6

"""Groups of sectors, and what messages cost."""

import pytest
import torch

from mirror_ppl.domains.highway.lidar import SECTORS
from mirror_ppl.domains.highway.messages import GROUPS, SEEN, SHOWN, SPOKEN, cost, sectors_of


def test_groups_part_the_sectors_and_are_mirrored():
    assert sorted(sector for group in GROUPS for sector in group) == list(range(SECTORS))
    mirror = [sorted(-sector % SECTORS for sector in group) for group in GROUPS]
    left_for_right = (0, 5, 4, 3, 2, 1)
    assert mirror == [sorted(GROUPS[each]) for each in left_for_right]
    assert 0 in GROUPS[0] and 18 in GROUPS[3]


def test_sectors_that_groups_show():
    shown = torch.zeros(2, 6, dtype=torch.bool)
    shown[1, [0, 3]] = True
    found = sectors_of(shown)
    assert not found[0].any()
    assert found[1].nonzero()[:, 0].tolist() == sorted(GROUPS[0] + GROUPS[3])


@pytest.mark.parametrize(
    ("shown", "said", "expected"),
    [(0, 0, 0.0), (1, 0, 0.01), (3, 0, 0.09), (0, 2, 0.12), (2, 1, 0.07)],
)
def test_costs_are_those_of_driving_in_table_i(shown, said, expected):
    items = torch.arange(6)
    assert cost(items < shown, items < said).item() == pytest.approx(expected)


def test_modalities_name_what_there_is():
    assert len(SEEN.items) == SECTORS and len(set(SEEN.items)) == SECTORS
    assert SHOWN.items == SPOKEN.items and len(SHOWN.items) == 6

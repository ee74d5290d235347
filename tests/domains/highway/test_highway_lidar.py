"""Lidar and geometry against distances that are worked out by hand."""

import math

import pytest
import torch
from highway_states import state_of

from mirror_ppl.domains.highway.geometry import clearance, corners, overlap
from mirror_ppl.domains.highway.lidar import (
    RANGE,
    RESOLUTION,
    SECTOR,
    SECTORS,
    distances,
    nearest_in,
    scan,
)

DEGREE = math.pi / 180
HALF = RESOLUTION / 2 + 1e-9
"""Largest error of a measurement."""


def measured(*cars, ego=(0.0, 4.0, 0.0, 10.0)):
    return scan(state_of(ego, cars))


def test_an_empty_road():
    found = measured()
    assert found.shape == (SECTORS, 3)
    assert (found[:, 0] == RANGE).all() and (found[:, 1:] == 0).all()


def test_a_car_straight_ahead():
    """Its rear is at 17.5 m; half its width is within 5 degrees, so that one sector has it all."""
    found = measured((20.0, 4.0, 0.0, 7.0))
    assert found[0].tolist() == [17.5, -3.0, 0.0]
    assert (found[1:, 0] == RANGE).all() and (found[1:, 1:] == 0).all()


def test_a_car_straight_behind():
    found = measured((-12.0, 4.0, 0.0, 12.0))
    assert found[18].tolist() == pytest.approx([9.5, 2.0, 0.0], abs=HALF)
    # At 9.5 m, 5 degrees are 0.83 m: both neighbours see the rest of its front, 1 m wide.
    edge = 9.5 / math.cos(5 * DEGREE)
    assert found[[17, 19], 0].tolist() == pytest.approx([edge, edge], abs=HALF)
    assert (found[[16, 20], 0] == RANGE).all()


def test_a_car_abreast_on_the_right():
    """Its side at 3 m reaches 2.5 m ahead and behind: 39.8 degrees from the middle."""
    found = measured((0.0, 8.0, 0.0, 10.0))
    # Each sector's nearest point is on the bound that is nearer to abreast.
    for turned in range(1, 5):
        expected = 3 / math.cos((10 * turned - 5) * DEGREE)
        assert found[[9 - turned, 9 + turned], 0].tolist() == pytest.approx(
            [expected] * 2, abs=HALF
        )
    assert found[9, 0].item() == pytest.approx(3.0)
    seen = (found[:, 0] < RANGE).nonzero()[:, 0].tolist()
    # The near side ends within the sectors at 40 degrees; the far corner is at 26.6 degrees.
    assert seen == list(range(5, 14))


def test_left_and_right_are_mirrored_and_motion_turns_with_the_ego():
    found = measured((10.0, 8.0, 0.0, 12.0), (10.0, 0.0, 0.0, 12.0))
    assert torch.allclose(found[1:18, 0], found[19:, 0].flip(0))
    turned = measured((10.0, 8.0, 0.0, 12.0), ego=(0.0, 4.0, 30 * DEGREE, 10.0))
    shown = turned[turned[:, 0] < RANGE][:, 1:]
    expected = [12 * math.cos(30 * DEGREE) - 10, -12 * math.sin(30 * DEGREE)]
    assert len(shown) > 0
    assert torch.allclose(
        shown, torch.tensor(expected, dtype=shown.dtype).expand_as(shown), atol=HALF
    )


def test_the_nearest_car_hides_the_one_behind_it():
    found = measured((40.0, 4.0, 0.0, 1.0), (20.0, 4.0, 0.0, 7.0))
    assert found[0].tolist() == [17.5, -3.0, 0.0]


def test_a_crossing_car_fills_sectors_without_a_corner_in_them():
    """Across the road, 3 m ahead to its side, it is wider than the sector that faces ahead."""
    found = measured((4.0, 4.0, 90 * DEGREE, 5.0))
    assert found[0].tolist() == pytest.approx([3.0, -10.0, 5.0], abs=HALF)


def test_beyond_the_range_there_is_nothing():
    assert measured((RANGE + 2.4, 4.0, 0.0, 7.0))[0].tolist() == pytest.approx(
        [59.9, -3.0, 0.0], abs=HALF
    )
    assert measured((RANGE + 2.6, 4.0, 0.0, 7.0))[0].tolist() == [RANGE, 0.0, 0.0]


def test_inside_a_box_everything_is_at_no_distance():
    boxes = torch.tensor([[1.0, 0.5, 0.3]])
    assert (distances(boxes, torch.arange(SECTORS) * SECTOR) == 0).all()
    assert clearance(boxes).item() == 0


def test_cars_out_of_range_do_not_matter(generator):
    spread = torch.tensor([400.0, 10.0, 0.6])
    boxes = (torch.rand(200, 6, 3, generator=generator) - 0.5) * spread
    middles = torch.arange(SECTORS) * SECTOR
    least, which = nearest_in(boxes, middles)
    every, index = distances(boxes, middles).min(-2)
    hit = every < RANGE
    assert 0 < hit.sum() < hit.numel()
    torch.testing.assert_close(least[hit], every[hit], rtol=0, atol=0)
    assert torch.equal(which[hit], index[hit])
    assert (least[~hit] >= RANGE).all()


def test_sectors_agree_with_points_along_the_sides(generator):
    """The nearest of 2,000 points a side is within a step of the exact distance in each sector."""
    spread = torch.tensor([20.0, 20.0, 3.0], dtype=torch.float64)
    boxes = (torch.rand(100, 3, generator=generator, dtype=torch.float64) - 0.5) * spread
    boxes = boxes[clearance(boxes) > 0]
    exact = distances(boxes, torch.arange(SECTORS, dtype=torch.float64) * SECTOR)
    square = corners(boxes)[:, :, None]
    share = torch.linspace(0, 1, 2000, dtype=torch.float64)[:, None]
    points = (square + share * (square.roll(-1, 1) - square)).flatten(1, 2)
    length, angle = points.norm(dim=-1), torch.atan2(points[..., 1], points[..., 0])
    sector = (angle / SECTOR).round().long() % SECTORS
    strewn = torch.full_like(exact, math.inf).scatter_reduce(1, sector, length, "amin")
    hit = strewn.isfinite()
    assert hit.sum() > 300
    assert (strewn[hit] >= exact[hit] - 1e-9).all()
    assert (strewn[hit] <= exact[hit] + 5 / 1999).all()
    # What is left is shorter than a step of the points.
    assert (exact.isfinite() & ~hit).sum() < 5


def test_overlap_by_hand():
    first = torch.tensor([0.0, 0.0, 0.0])
    rows = {
        (4.9, 0.0, 0.0): True,
        (5.1, 0.0, 0.0): False,
        (0.0, 1.9, 0.0): True,
        (0.0, 2.1, 0.0): False,
        (3.4, 0.0, math.pi / 2): True,
        (3.6, 0.0, math.pi / 2): False,
        # A corner of the turned one is 2.47 m from its middle, less than that of the first is away.
        (4.9, 2.5, math.pi / 4): False,
        (3.9, 2.5, math.pi / 4): True,
    }
    for other, expected in rows.items():
        assert overlap(first, torch.tensor(other)).item() is expected, other
        assert overlap(torch.tensor(other), first).item() is expected, other

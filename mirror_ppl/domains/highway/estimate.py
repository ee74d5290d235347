"""States estimated from observations: cars where the lidar sees them, driving as they do now.

An observation does not determine the state. Cars hide behind others, and what vehicles intend
cannot be seen. The estimate has at most one car in each of the six directions of speech, the
nearest; it keeps its speed, and its lane unless it is moving sideways.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation
from mirror_ppl.domains.highway.lidar import RANGE, SECTOR, SECTORS
from mirror_ppl.domains.highway.road import (
    LANE_WIDTH,
    LANES,
    LENGTH,
    LIMIT,
    OTHERS,
    TICK,
    WIDTH,
    centre_of,
    lane_of,
)
from mirror_ppl.domains.highway.scenarios import HEADWAY
from mirror_ppl.domains.highway.speech import AHEAD, BRAKING, DIRECTIONS, SIDES, WORDS
from mirror_ppl.domains.highway.state import NEVER, HighwayState

LEVEL = 0.1
"""Metres behind the ego up to which a car counts as ahead, as ends are seen with small errors."""
SAME = 1e-3
"""m/s by which the motion of one car differs at most between two sectors."""
SIDEWAYS = 0.7
"""m/s across the road from which a car counts as changing lanes."""
AWAY = 1000.0
"""Metres at which cars are that nothing is known of."""
HARD = 2 * BRAKING
"""m/s2 by which a car slows down of which it is said that it brakes."""
SOON = int(2.0 / TICK)
"""Ticks for which it is expected to go on braking."""


@dataclass(frozen=True)
class Cars:
    """Cars around the ego, one for each of the six directions.

    Attributes:
        there: whether there is one, boolean ``[..., 6]``; else the other fields mean nothing.
        x: metres ahead of the ego ``[..., 6]``, of the car's centre.
        y: metres across the road ``[..., 6]``.
        speed: m/s along the road ``[..., 6]``.
        sideways: m/s across the road ``[..., 6]``, to the right.
        brakes: whether it is known to brake, boolean ``[..., 6]``.
    """

    there: Tensor
    x: Tensor
    y: Tensor
    speed: Tensor
    sideways: Tensor
    brakes: Tensor


def cars_in(observation: Observation) -> Cars:
    """Return the nearest cars ``[..., 6]`` that the lidar sees; sentences say which of them brake.

    Points in one lane that move alike and are within a car's length are of one car. One that is
    wholly ahead or behind shows its near end, one abreast both ends.
    """
    lane, offset, heading, speed = observation["ego"][..., :4].unbind(-1)
    distance, along, across = observation["visual"].unbind(-1)
    turned = _angles(observation["visual"]) + heading[..., None]
    y = (centre_of(lane) + offset)[..., None] + distance * torch.sin(turned)
    x, hit = distance * torch.cos(turned), lane_of(y)
    centre = _centres(observation["visual"], x, hit)
    sides = torch.tensor(SIDES, device=lane.device)
    ahead = torch.tensor(AHEAD, device=lane.device)
    here = (hit - lane[..., None].long())[..., None, :] == sides[:, None]
    here = here & ((centre >= -LEVEL)[..., None, :] == ahead[:, None])
    here = here & (distance < RANGE)[..., None, :]
    least, which = torch.where(here, centre.abs()[..., None, :], math.inf).min(-1)
    centre, y, hit, along, across = (
        part.gather(-1, which) for part in (centre, y, hit, along, across)
    )

    sin, cos = torch.sin(heading)[..., None], torch.cos(heading)[..., None]
    forward = along + speed[..., None]
    sideways = forward * sin + across * cos
    middle = centre_of(hit).to(y)
    off = y - middle
    # A car that changes lanes is where it is seen, any other in the middle of its lane.
    seen_at = middle + (off.abs() - WIDTH / 2).clamp(0, LANE_WIDTH / 2) * off.sign()
    said = observation["verbal"][..., 0].round().long()
    there = least.isfinite()
    return Cars(
        there=there,
        x=centre,
        y=torch.where(sideways.abs() > SIDEWAYS, seen_at, middle),
        speed=forward * cos - across * sin,
        sideways=sideways,
        brakes=there & (said == WORDS.index("braking")),
    )


def _centres(visual: Tensor, x: Tensor, lane: Tensor) -> Tensor:
    """Return how many metres ahead the car is ``[..., 36]`` that each sector sees.

    Args:
        visual: ``[..., 36, 3]``.
        x: metres ahead of the nearest points ``[..., 36]``.
        lane: of these points ``[..., 36]``.
    """
    seen, motion = visual[..., 0] < RANGE, visual[..., 1:]
    # One part of the motion at a time: operations over a dimension of two are slow.
    apart = [_differences(motion[..., part].contiguous()) for part in range(2)]
    one = torch.maximum(*apart) < SAME
    one = one & (_differences(x) <= LENGTH)
    one = one & (lane[..., None] == lane[..., None, :]) & seen[..., None, :]
    least = torch.where(one, x[..., None, :], math.inf).amin(-1)
    most = torch.where(one, x[..., None, :], -math.inf).amax(-1)
    abreast = (least + most) / 2
    beyond = torch.where(least >= 0, least + LENGTH / 2, most - LENGTH / 2)
    return torch.where((least < 0) & (most > 0), abreast, beyond)


def _differences(values: Tensor) -> Tensor:
    """Return absolute differences ``[..., n, n]`` of values ``[..., n]``."""
    return (values[..., None] - values[..., None, :]).abs_()


def _angles(visual: Tensor) -> Tensor:
    """Return the angle ``[..., 36]`` to the ego's heading of the nearest point in each sector.

    A car that is also in the next sector comes nearest at the line between both, or anywhere if it
    is in both neighbours; one that is in no other may be anywhere, so that the middle is taken.
    """
    sectors = torch.arange(SECTORS, dtype=visual.dtype, device=visual.device)
    seen = visual[..., 0] < RANGE
    following, motion = seen.roll(-1, -1), visual[..., 1:]
    same = ((motion - motion.roll(-1, -2)).abs() < SAME).all(-1) & seen & following
    side = same.to(visual.dtype) - same.roll(1, -1).to(visual.dtype)
    return (sectors + side / 2) * SECTOR


def state_of(observation: Observation) -> HighwayState:
    """Return an estimate ``[...]`` of the state with this full observation ``[..., K, F]``.

    Exact are the ego's position across the road, heading, speed, last controls, and whether there
    was an accident. The ego is at ``x = 0``, and the round begins now.
    """
    return state_with(observation["ego"], cars_in(observation))


def state_with(ego: Tensor, cars: Cars) -> HighwayState:
    """Return the state ``[...]`` of an ego, as observed ``[..., 7]``, among cars ``[..., 6]``."""
    lane, offset, heading, speed, steering, acceleration, accident = ego.unbind(-1)
    y, zero = centre_of(lane) + offset, torch.zeros_like(speed)
    moves = cars.sideways.abs() > SIDEWAYS
    # Who moves aims for the next middle of a lane on that side.
    across = cars.y / LANE_WIDTH
    following = torch.where(cars.sideways > 0, across.ceil(), across.floor()).long()
    aim = torch.where(moves, following.clamp(0, LANES - 1), lane_of(cars.y))
    fast = torch.hypot(cars.speed, torch.where(moves, cars.sideways, 0.0))
    slowed = (fast - HARD * SOON * TICK).clamp(min=0)
    slowing = torch.full_like(fast, -HARD)

    def join(of_ego: Tensor, of_cars: Tensor, absent: float) -> Tensor:
        """Return values ``[..., 1 + OTHERS]``; absent cars all have the same."""
        of_cars = torch.where(cars.there, of_cars, torch.full_like(of_cars, absent))
        none = of_cars.new_full((*of_cars.shape[:-1], OTHERS - len(DIRECTIONS)), absent)
        return torch.cat([of_ego[..., None].to(of_cars.dtype), of_cars, none], -1)

    x = join(zero, cars.x, math.nan)
    far = AWAY * torch.arange(1.0, 2 + OTHERS, dtype=x.dtype, device=x.device)
    target = join(lane_of(y), aim, 0)
    never = torch.full_like(target, NEVER)
    brakes = join(zero, cars.brakes.to(fast), 0.0) > 0
    return HighwayState(
        x=torch.where(x.isnan(), far, x),
        y=join(y, cars.y, 0.0),
        heading=join(heading, torch.atan2(cars.sideways, cars.speed.clamp(min=0.1)) * moves, 0.0),
        speed=join(speed, fast, LIMIT),
        acceleration=join(zero, torch.where(cars.brakes, slowing, torch.zeros_like(fast)), 0.0),
        target_lane=target,
        cruise=join(torch.full_like(speed, LIMIT), fast, LIMIT),
        headway=torch.full_like(x, HEADWAY),
        changes=torch.zeros_like(x, dtype=torch.bool),
        timer=torch.zeros_like(target),
        cue_at=never,
        cue_gap=torch.full_like(x, -math.inf),
        cue_lane=target,
        cue_speed=join(speed, slowed, LIMIT),
        cue_for=torch.full_like(target, SOON),
        begun=torch.where(brakes, 0, never),
        controls=torch.stack([steering, acceleration], -1),
        tick=torch.zeros_like(lane, dtype=torch.long),
        crashed=accident > 0,
    )

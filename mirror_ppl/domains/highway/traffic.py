"""Physics of traffic, batched and pure: bicycle model, IDM, MOBIL and scripted events.

The equations and constants are those of highway-env's ``Vehicle``, ``ControlledVehicle`` and
``IDMVehicle`` on a straight road, so that a round here is a round there; tests compare them.

===============  =======================================================================
bicycle model    ``beta = atan(tan(steering) / 2)``, ``x' = v cos(heading + beta)``,
                 ``y' = v sin(heading + beta)``, ``heading' = 2 v sin(beta) / LENGTH``
lane keeping     proportional control of lateral position, then of heading
following        the Intelligent Driver Model
changing lanes   MOBIL without politeness: to where the own acceleration is larger by
                 ``CHANGE_GAIN``, if the next vehicle there need not brake harder than
                 ``IMPOSED_BRAKING``
===============  =======================================================================

Departures from highway-env
    - Only the ego is tested for collisions, and one stops its round. highway-env also pushes
      vehicles apart that are about to touch.
    - Within a tick all vehicles decide at once. highway-env decides one after the other, so that a
      vehicle that gives up a lane change can know of one that begun within the same tick.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from mirror_ppl.domains.highway.geometry import overlap
from mirror_ppl.domains.highway.manoeuvres import controls
from mirror_ppl.domains.highway.road import (
    EGO_SPEEDS,
    LANE_WIDTH,
    LANES,
    LENGTH,
    MAX_ACCELERATION,
    MAX_STEERING,
    TICK,
    TICKS,
    centre_of,
    wrapped,
)
from mirror_ppl.domains.highway.state import NEVER, HighwayState, flat, shaped, where

MOST_ACCELERATION = 6.0
"""m/s2 at which other vehicles accelerate and brake at most."""
COMFORT, COMFORT_BRAKING = 3.0, 5.0
"""The IDM's comfortable acceleration and braking in m/s2."""
JAM_DISTANCE = 5.0 + LENGTH
"""The IDM's distance in metres between the centres of standing vehicles."""
EXPONENT = 4.0
"""The IDM's exponent of speed."""
ROAD_LIMIT = 30.0
"""m/s that no vehicle intends to exceed, highway-env's speed limit of lanes."""
VEHICLE_SPEEDS = (-40.0, 40.0)
"""Speeds in m/s beyond which accelerations of other vehicles are opposed."""

CHANGE_GAIN = 0.2
IMPOSED_BRAKING = 2.0
CHANGE_PERIOD = 20
"""Ticks between two times at which a vehicle considers to change lanes: one second."""
SLOWEST_CHANGE = 1.0
"""m/s below which vehicles do not change lanes."""
ON_LANE = LANE_WIDTH / 2 + 1.0
"""Metres from a lane's centre within which a vehicle counts as in that lane, for followers."""

HEADING_GAIN, LATERAL_GAIN = 5.0, 1 / 0.6
"""Gains of lane keeping, per second."""
WHEEL_LIMIT = math.pi / 3
"""Radians of the front wheels of other vehicles."""
SLIP_LIMIT = math.atan(math.tan(WHEEL_LIMIT) / 2)
"""Radians between their heading and their course at that limit."""
SMALL = 1e-2
"""Speeds, distances: nothing is divided by less."""


def transition(state: HighwayState, action: Tensor, ticks: int = TICKS) -> HighwayState:
    """Return the state some ticks later; rounds that are over stay as they are.

    Args:
        state: ``[...]``.
        action: the ego's manoeuvre ``[...]``, which a controller carries out tick by tick; or
            steering (positive to the right) and acceleration ``[..., 2]``, which are held.
        ticks: number of ticks.
    """
    start, shape = flat(state)
    held = action.is_floating_point()
    action = action.expand(*shape, 2).reshape(-1, 2) if held else action.expand(shape).reshape(-1)
    now = start
    for _ in range(ticks):
        later = tick(replace(now, controls=controls(now, action)))
        now = where(now.crashed, now, later) if now.crashed.any() else later
    return shaped(where(start.over, start, now) if start.over.any() else now, shape)


@dataclass(frozen=True)
class Flow:
    """What drivers go by: fields of `HighwayState` of these names, ``[..., N]``."""

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor
    headway: Tensor
    intended: Tensor
    lane: Tensor
    target_lane: Tensor

    @classmethod
    def of(cls, state: HighwayState) -> Flow:
        """Return the flow of a state."""
        return cls(**{field.name: getattr(state, field.name) for field in fields(cls)})

    def rows(self, row: Tensor) -> Flow:
        """Return the flow of some rounds of a batch ``[B]``."""
        return Flow(**{name: part[row] for name, part in vars(self).items()})


def tick(state: HighwayState) -> HighwayState:
    """Return the state ``[B]`` one tick later, the ego's controls being ``state.controls``."""
    state = begin_events(state)
    flow = Flow.of(state)
    idle = state.changes & (flow.lane == flow.target_lane)
    considers = idle & (state.timer >= CHANGE_PERIOD)
    flow = replace(flow, target_lane=change_lanes(flow, state.changes, considers))

    steering, acceleration = steer_to(flow, centre_of(flow.target_lane)), followed(flow)
    scales = state.x.new_tensor([MAX_STEERING, MAX_ACCELERATION])
    ego_steering, ego_acceleration = (state.controls * scales)[..., None].unbind(-2)
    steering = torch.cat([ego_steering, steering[..., 1:]], -1)
    acceleration = torch.cat([ego_acceleration, acceleration[..., 1:]], -1)

    moved = bicycle(state, steering, acceleration)
    boxes = torch.stack([moved.x, moved.y, moved.heading], -1)
    hit = overlap(boxes[..., :1, :], boxes[..., 1:, :]).any(-1)
    return replace(
        moved,
        target_lane=flow.target_lane,
        timer=state.timer * ~considers + 1,
        tick=state.tick + 1,
        crashed=state.crashed | hit,
    )


def bicycle(state: HighwayState, steering: Tensor, acceleration: Tensor) -> HighwayState:
    """Return the state after ``TICK`` seconds.

    Args:
        state: ``[..., N]``.
        steering: radians of the front wheels ``[..., N]``.
        acceleration: m/s2 ``[..., N]``, before limits of speed.
    """
    speed = state.speed
    others = speed.shape[-1] - 1
    limits = zip(EGO_SPEEDS, VEHICLE_SPEEDS, strict=True)
    least, most = (speed.new_tensor([ego, *[other] * others]) for ego, other in limits)
    limited = torch.where(speed > most, torch.minimum(acceleration, most - speed), acceleration)
    limited = torch.where(speed < least, torch.maximum(acceleration, least - speed), limited)
    slip = torch.atan(torch.tan(steering) / 2)
    course, way = state.heading + slip, speed * TICK
    return replace(
        state,
        x=state.x + way * torch.cos(course),
        y=state.y + way * torch.sin(course),
        heading=state.heading + way * torch.sin(slip) / (LENGTH / 2),
        speed=speed + limited * TICK,
        acceleration=limited,
    )


def steer_to(flow: Flow, y: Tensor) -> Tensor:
    """Return radians of the front wheels ``[..., N]`` by which vehicles move to ``y``."""
    small = torch.full_like(flow.speed, SMALL).copysign(flow.speed)
    speed = torch.where(flow.speed.abs() > SMALL, flow.speed, small)
    course = torch.asin((LATERAL_GAIN * (y - flow.y) / speed).clamp(-1, 1))
    course = course.clamp(-math.pi / 4, math.pi / 4)
    turning = HEADING_GAIN * wrapped(course - flow.heading)
    slip = torch.asin((LENGTH / 2 / speed * turning).clamp(-1, 1))
    # Before the tangent, which has the wrong sign at a right angle that is rounded up.
    return torch.atan(2 * torch.tan(slip.clamp(-SLIP_LIMIT, SLIP_LIMIT)))


def idm(speed: Tensor, intended: Tensor, headway: Tensor, gap: Tensor, closing: Tensor) -> Tensor:
    """Return the acceleration of the Intelligent Driver Model, m/s2 ``[...]``, without limits.

    Args:
        speed: m/s.
        intended: m/s on a free road.
        headway: seconds to the vehicle ahead.
        gap: metres between centres, not negative; infinite without a vehicle ahead.
        closing: m/s at which the gap shrinks.
    """
    share = speed.clamp(min=0) / intended.clamp(SMALL, ROAD_LIMIT)
    crowded = wanted_gap(speed, headway, closing) / gap.clamp(min=SMALL)
    return COMFORT * (1 - share**EXPONENT - crowded**2)


def wanted_gap(speed: Tensor, headway: Tensor, closing: Tensor) -> Tensor:
    """Return the gap in metres that the IDM wants; arguments as for `idm`."""
    return JAM_DISTANCE + speed * (headway + closing / (2 * math.sqrt(COMFORT * COMFORT_BRAKING)))


def followed(flow: Flow) -> Tensor:
    """Return accelerations ``[B, N]`` by the IDM behind vehicles of the own and target lane."""
    everybody = torch.arange(flow.x.shape[-1], device=flow.x.device).expand_as(flow.lane)
    wanted = _behind(flow, everybody, flow.lane)
    row, who = _pairs(flow.lane != flow.target_lane)
    if len(row):
        target = flow.target_lane[row, who]
        there = _behind(flow.rows(row), who[:, None], target[:, None])[:, 0]
        wanted = wanted.index_put((row, who), torch.minimum(wanted[row, who], there))
    return wanted.clamp(-MOST_ACCELERATION, MOST_ACCELERATION)


def begin_events(state: HighwayState) -> HighwayState:
    """Return the state with events begun whose moment has come."""
    now = state.tick[..., None]
    due = (state.begun == NEVER) & (now >= state.cue_at)
    begins = due & (state.x - state.x[..., :1] >= state.cue_gap)
    return replace(
        state,
        begun=torch.where(begins, now, state.begun),
        target_lane=torch.where(begins, state.cue_lane, state.target_lane),
    )


def change_lanes(flow: Flow, changes: Tensor, considers: Tensor) -> Tensor:
    """Return the lanes ``[B, N]`` that vehicles move to: MOBIL, and changes that are given up.

    Args:
        flow: ``[B]``.
        changes: vehicles ``[B, N]`` that change lanes on their own.
        considers: vehicles ``[B, N]`` whose turn it is to consider a change.
    """
    lane, target = flow.lane, flow.target_lane
    row, who = _pairs(changes & (lane != target))
    if len(row):
        given_up = _rival(flow.rows(row), who)
        kept = torch.where(given_up, lane[row, who], target[row, who])
        target = target.index_put((row, who), kept)
    row, who = _pairs(considers & (flow.speed.abs() >= SLOWEST_CHANGE))
    if len(row):
        target = target.index_put((row, who), _best_lane(flow.rows(row), who))
    return target


def neighbours(flow: Flow, who: Tensor, lane: Tensor) -> tuple[Tensor, Tensor]:
    """Return the next vehicles ahead of and behind some vehicles, in given lanes.

    Args:
        flow: ``[...]``.
        who: indices of vehicles ``[..., M]``.
        lane: a lane for each ``[..., M]``.

    Returns:
        Two tensors of indices ``[..., M]``; -1 where there is none.
    """
    offset, there = _offsets(flow, who, lane)
    return _least(offset, there & (offset >= 0)), _least(-offset, there & (offset < 0))


def _offsets(flow: Flow, who: Tensor, lane: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far ahead vehicles are of ``who``, and whether in the lane, ``[..., M, N]``."""
    others = torch.arange(flow.x.shape[-1], device=flow.x.device)
    offset = flow.x[..., None, :] - flow.x.gather(-1, who)[..., None]
    across = flow.y[..., None, :] - centre_of(lane)[..., None]
    return offset, (across.abs() <= ON_LANE) & (others != who[..., None])


def _least(distance: Tensor, candidates: Tensor) -> Tensor:
    least, index = torch.where(candidates, distance, math.inf).min(-1)
    return torch.where(least.isinf(), -1, index)


def _behind(flow: Flow, who: Tensor, lane: Tensor) -> Tensor:
    """Return accelerations ``[..., M]`` of vehicles behind the next one in given lanes."""
    offset, there = _offsets(flow, who, lane)
    gap, closing = _towards(flow, who, _least(offset, there & (offset >= 0)))
    speed, headway = flow.speed.gather(-1, who), flow.headway.gather(-1, who)
    return idm(speed, flow.intended.gather(-1, who), headway, gap, closing)


def _rival(flow: Flow, who: Tensor) -> Tensor:
    """Return whether ``[B]`` another vehicle, too near ahead of ``who``, moves to its lane."""
    at = who[:, None]
    gap = flow.x - flow.x.gather(-1, at)
    speed, headway = flow.speed.gather(-1, at), flow.headway.gather(-1, at)
    closing = speed - flow.speed * torch.cos(flow.heading - flow.heading.gather(-1, at))
    near = (gap > 0) & (gap < wanted_gap(speed, headway, closing))
    same = flow.target_lane == flow.target_lane.gather(-1, at)
    # What the ego intends is not known.
    return (near & same & (flow.lane != flow.target_lane))[..., 1:].any(-1)


def _best_lane(flow: Flow, who: Tensor) -> Tensor:
    """Return the lane ``[B]`` that MOBIL chooses for vehicles ``who`` ``[B]``."""
    here = flow.lane.gather(-1, who[:, None])
    lanes = here + torch.tensor([-1, 1, 0], device=here.device)
    many = who[:, None].expand_as(lanes)
    ahead, behind = neighbours(flow, many, lanes)
    headway = flow.headway.gather(-1, many)

    def accelerated(follower: Tensor, leader: Tensor) -> Tensor:
        """Return accelerations with the headway of the vehicle that decides, in another's place."""
        gap, closing = _towards(flow, follower, leader)
        at = follower.clamp(min=0)
        speed, intended = flow.speed.gather(-1, at), flow.intended.gather(-1, at)
        return idm(speed, intended, headway, gap, closing)

    own = accelerated(many, ahead)
    good = (own[:, :2] - own[:, 2:]) >= CHANGE_GAIN
    good = good & ((behind < 0) | (accelerated(behind, many) >= -IMPOSED_BRAKING))[:, :2]
    left, right = (good & (lanes[:, :2] >= 0) & (lanes[:, :2] < LANES)).unbind(-1)
    # As in highway-env, the right lane is considered last.
    return here[:, 0] + torch.where(right, 1, -left.long())


def _towards(flow: Flow, who: Tensor, leader: Tensor) -> tuple[Tensor, Tensor]:
    """Return gap in metres and closing speed in m/s ``[..., M]``; infinity and 0 without leader."""
    own, other = who.clamp(min=0), leader.clamp(min=0)
    turned = flow.heading.gather(-1, other) - flow.heading.gather(-1, own)
    closing = flow.speed.gather(-1, own) - flow.speed.gather(-1, other) * torch.cos(turned)
    gap = flow.x.gather(-1, other) - flow.x.gather(-1, own)
    none = leader < 0
    return gap.masked_fill(none, math.inf), closing.masked_fill(none, 0.0)


def _pairs(which: Tensor) -> tuple[Tensor, Tensor]:
    """Return rounds and vehicles of true entries ``[B, N]``, but for the ego's."""
    row, who = which[:, 1:].nonzero(as_tuple=True)
    return row, who + 1

"""The state of a batch of rounds: vehicles, what they intend, and their scripted events."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.highway.road import LEFT_EDGE, RIGHT_EDGE, SHOULDER, lane_of

NEVER = 10**6
"""Tick of an event that does not happen."""


@dataclass(frozen=True)
class HighwayState:
    """State of a batch of rounds; vehicle 0 of ``N = 1 + OTHERS`` is the ego.

    An event of a vehicle begins at the first tick from ``cue_at`` on at which the vehicle is at
    least ``cue_gap`` metres ahead of the ego. It then heads for lane ``cue_lane``, and intends to
    drive at ``cue_speed`` for ``cue_for`` ticks. What belongs to the ego in fields from
    ``target_lane`` to ``begun`` is not used, but for its ``cruise``: others expect of the ego that
    it wants to drive at that speed.

    Attributes:
        x: metres along the road ``[..., N]``, of the vehicle's centre.
        y: metres across the road ``[..., N]``, to the right.
        heading: radians ``[..., N]``, clockwise, 0 along the road.
        speed: m/s ``[..., N]`` in the direction of the heading.
        acceleration: m/s2 ``[..., N]`` in the last tick.
        target_lane: lane ``[..., N]`` that the vehicle drives in or moves to.
        cruise: speed in m/s ``[..., N]`` that it intends when no event says otherwise.
        headway: seconds ``[..., N]`` that it keeps to the vehicle ahead.
        changes: whether ``[..., N]`` it changes lanes when that is faster (MOBIL).
        timer: ticks ``[..., N]`` since it last considered to change lanes.
        cue_at: tick ``[..., N]`` from which its event may begin; ``NEVER`` without one.
        cue_gap: metres ``[..., N]``, see above.
        cue_lane: lane ``[..., N]``, see above.
        cue_speed: m/s ``[..., N]``, see above.
        cue_for: ticks ``[..., N]``, see above.
        begun: tick ``[..., N]`` at which the event began; ``NEVER`` before that.
        controls: the ego's last action ``[..., 2]``: steering and acceleration in [-1, 1].
        tick: ticks ``[...]`` since the round began.
        crashed: whether ``[...]`` the ego hit another vehicle.
    """

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor
    acceleration: Tensor
    target_lane: Tensor
    cruise: Tensor
    headway: Tensor
    changes: Tensor
    timer: Tensor
    cue_at: Tensor
    cue_gap: Tensor
    cue_lane: Tensor
    cue_speed: Tensor
    cue_for: Tensor
    begun: Tensor
    controls: Tensor
    tick: Tensor
    crashed: Tensor

    @property
    def lane(self) -> Tensor:
        """Lane ``[..., N]`` with the nearest centre."""
        return lane_of(self.y)

    @property
    def intended(self) -> Tensor:
        """Speed in m/s ``[..., N]`` that vehicles intend to drive at now."""
        since = self.tick[..., None] - self.begun
        return torch.where((since >= 0) & (since < self.cue_for), self.cue_speed, self.cruise)

    @property
    def off_road(self) -> Tensor:
        """Whether ``[...]`` the ego's centre has left the shoulder."""
        y = self.y[..., 0]
        return (y < LEFT_EDGE - SHOULDER) | (y > RIGHT_EDGE + SHOULDER)

    @property
    def over(self) -> Tensor:
        """Whether ``[...]`` the round has ended with an accident."""
        return self.crashed | self.off_road


def where(condition: Tensor, yes: HighwayState, no: HighwayState) -> HighwayState:
    """Return states of ``yes`` where ``condition`` ``[...]`` is true, and of ``no`` elsewhere."""

    def choose(one: Tensor, other: Tensor) -> Tensor:
        wide = condition.reshape(condition.shape + (1,) * (one.dim() - condition.dim()))
        return torch.where(wide, one, other)

    return map_state(choose, yes, no)


def flat(state: HighwayState) -> tuple[HighwayState, torch.Size]:
    """Return a state with one batch dimension, and the shape that the batch had."""
    shape = state.tick.shape
    parts = {}
    for field in fields(state):
        part = getattr(state, field.name)
        parts[field.name] = part.reshape(-1, *part.shape[len(shape) :])
    return HighwayState(**parts), shape


def shaped(state: HighwayState, shape: torch.Size) -> HighwayState:
    """Return a state ``[B]`` with a batch of another shape; undoes `flat`."""
    return map_state(lambda part: part.reshape((*shape, *part.shape[1:])), state)

"""What a driver knows of the cars around: those seen, those spoken of, those remembered.

A car out of sight is expected to drive on as it did for ``REMEMBERED`` decisions; of all else there
is nothing, as far as the driver knows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, RepeatedObservation, Visibility, map_state
from mirror_ppl.domains.highway.estimate import Cars, cars_in, state_with
from mirror_ppl.domains.highway.lidar import RANGE, SECTORS, scan
from mirror_ppl.domains.highway.messages import GROUPS, group_of
from mirror_ppl.domains.highway.road import DECISION_TICKS, LENGTH, TICK, centre_of, lane_of
from mirror_ppl.domains.highway.speech import AHEAD, DIRECTIONS, NOTHING, SIDES, WORDS
from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows
from mirror_ppl.shapes import broadcast_shapes

GROUP_OF = tuple(group_of(sector) for sector in range(SECTORS))
"""Direction of speech of each sector."""
FIRST = tuple(sectors[0] for sectors in GROUPS)
"""One sector of each direction of speech."""
SECONDS = TICK * DECISION_TICKS
"""Seconds of a decision."""
REMEMBERED = 6
"""Decisions (3 s) for which a car out of sight is expected to drive on."""
HEARD_AT = (25.0, 20.0)
"""Metres at which drivers imagine a car ahead, and one behind, that a sentence is about."""
HEARD_FASTER = (5.0, 1.5, -5.0, -0.5, 2.0)
"""m/s at which its distance shrinks in their minds, by sentence."""


@dataclass(frozen=True)
class Memory(Cars):
    """The cars that drivers know of.

    Attributes:
        age: decisions since each was seen, shown or spoken of ``[..., 6]``.
        own_speed: the driver's own speed in m/s ``[..., 1]`` at the last decision.
    """

    age: Tensor
    own_speed: Tensor


def nothing(*batch: int, like: Tensor) -> Memory:
    """Return memories ``[*batch]`` before anything was seen, of the dtype of a tensor."""
    zero = like.new_zeros(*batch, len(DIRECTIONS))
    no = zero > 0
    return Memory(no, zero, zero, zero, zero, no, zero, zero[..., :1])


def remember(
    memory: Memory,
    observation: Observation,
    seen: Tensor,
    heard: Tensor,
    hidden: Callable[[Tensor], Tensor],
) -> Memory:
    """Return the memory after a look at sectors ``[..., 36]`` and sentences ``[..., 6]``.

    Args:
        memory: of the decision before, ``[...]``.
        observation: everything that there is.
        seen: the sectors that are seen.
        heard: the sentences that are heard.
        hidden: returns where a car in each direction is out of sight, ``[..., 6]``, given the
            distance of its near end in metres.
    """
    ego, visual, verbal = (observation[name] for name in ("ego", "visual", "verbal"))
    said = torch.where(heard, verbal[..., 0], float(NOTHING))
    # An empty sector is like one that is out of sight.
    seen = seen & (visual[..., 0] < RANGE)
    sight = once_each(
        _in_sight,
        (ego, 1),
        (visual, 2),
        (seen, 1),
        (said, 1),
        key=[_numbers(observation), seen, said],
    )
    now = Memory(**vars(sight), age=torch.zeros_like(sight.x), own_speed=ego[..., 3:4])
    sentence = said.round().long()
    after = _either(now, _told(ego, sentence), _expected(memory, ego, hidden))
    # Told that nothing is there, a driver forgets a car.
    free = heard & (sentence == NOTHING)
    return replace(after, there=after.there & ~(free & ~now.there))


def _in_sight(ego: Tensor, visual: Tensor, seen: Tensor, said: Tensor) -> Cars:
    """Return the cars ``[n]`` in the sectors that are seen; ``said`` says which of them brake."""
    empty = visual.new_tensor([RANGE, 0.0, 0.0])
    shown = torch.where(seen[..., None], visual, empty)
    return cars_in({"ego": ego, "visual": shown, "verbal": said[..., None]})


def _numbers(observation: Observation) -> Tensor:
    """Return whole numbers ``[..., n]`` that differ between observations ``[...]``."""
    if isinstance(observation, RepeatedObservation):
        return observation.row[..., None]
    parts = observation["ego"], observation["visual"].flatten(-2), observation["verbal"].flatten(-2)
    if parts[0].shape[:-1].numel() == 1:  # the same for everybody
        return torch.zeros_like(parts[0][..., :1], dtype=torch.long)
    return torch.cat([as_whole_numbers(part) for part in parts], -1)


def imagined(memory: Memory, observation: Observation) -> Observation:
    """Return the full observation ``[..., 36, 3]`` if there were these cars, and no others."""
    names = [field.name for field in fields(Cars)]

    def scanned(ego: Tensor, *cars: Tensor) -> Tensor:
        return scan(state_with(ego, Cars(**dict(zip(names, cars, strict=True)))))

    parts = [(getattr(memory, name), 1) for name in names]
    return {**observation, "visual": once_each(scanned, (observation["ego"], 1), *parts)}


def out_of_sight(sees: Callable[[Observation], Visibility], observation: Observation):
    """Return the function ``hidden`` of `remember`, for someone who sees as ``sees`` says."""

    def hidden(distance: Tensor) -> Tensor:
        visual = torch.zeros(*distance.shape[:-1], SECTORS, 3).to(distance)
        visual[..., 0] = distance[..., list(GROUP_OF)]
        return ~sees({**observation, "visual": visual})["visual"][..., list(FIRST)]

    return hidden


def once_each(
    function: Callable[..., Any], *parts: tuple[Tensor, int], key: Sequence[Tensor] = ()
) -> Any:
    """Apply a function of batches to each distinct row of them once.

    Many people who see differently far know of the same cars.

    Args:
        function: of tensors ``[n, ...]``, to a tensor ``[n, ...]`` or a dataclass of such.
        parts: tensors ``[..., *]`` and their numbers of dimensions ``*``.
        key: numbers ``[..., k]`` that differ between different rows; the parts unless given.
    """
    shapes = [part.shape[: part.dim() - own] for part, own in parts]
    shape = broadcast_shapes(*shapes)
    batch = shape or (1,)
    key = key or [part.flatten(part.dim() - own) for part, own in parts]
    numbers = [as_whole_numbers(part).expand(*batch, part.shape[-1]) for part in key]
    rows = torch.cat(numbers, -1).flatten(0, -2)
    first, index = distinct_rows(rows)
    if len(first) == len(rows):  # in their order, so that all are rounded as without this
        first = index = torch.arange(len(rows), device=rows.device)
    place, rest = (), first
    for size in reversed(batch):
        place, rest = (rest % size, *place), rest // size
    found = function(
        *(
            part.expand(*batch, *part.shape[len(own) :])[place]
            for (part, _), own in zip(parts, shapes, strict=True)
        )
    )

    def spread(part: Tensor) -> Tensor:
        return part[index].view(*shape, *part.shape[1:])

    return spread(found) if isinstance(found, Tensor) else map_state(spread, found)


def _told(ego: Tensor, said: Tensor) -> Memory:
    """Return the cars ``[..., 6]`` that sentences are about, as drivers imagine them."""
    ahead = torch.tensor(AHEAD, device=ego.device)
    sides = torch.tensor(SIDES, device=ego.device)
    there = said < NOTHING
    faster = torch.tensor((*HEARD_FASTER, 0.0), dtype=ego.dtype, device=ego.device)[said]
    x = torch.where(ahead, HEARD_AT[0], -HEARD_AT[1]).to(ego).expand(said.shape)
    own = ego[..., 3:4]
    lane = ego[..., :1].round().long() + sides
    return Memory(
        there=there,
        x=x,
        y=centre_of(lane).to(ego),
        speed=(own + torch.where(ahead, -faster, faster)).clamp(min=0),
        sideways=torch.zeros_like(x),
        brakes=there & (said == WORDS.index("braking")),
        age=torch.zeros_like(x),
        own_speed=own,
    )


def _expected(memory: Memory, ego: Tensor, hidden: Callable[[Tensor], Tensor]) -> Memory:
    """Return what is expected of remembered cars, in the directions in which they are now.

    A driver who looks where a car should be and does not see it forgets it, as does one who has not
    seen it for a while.
    """
    driven = SECONDS * (memory.own_speed + ego[..., 3:4]) / 2
    x = memory.x + SECONDS * memory.speed - driven
    side = lane_of(memory.y) - ego[..., :1].round().long()
    ahead = torch.tensor(AHEAD, device=ego.device)
    sides = torch.tensor(SIDES, device=ego.device)
    lasts = memory.there & (memory.age + 1 <= REMEMBERED)
    # [..., direction, remembered car]
    here = (side[..., None, :] == sides[:, None]) & ((x >= 0)[..., None, :] == ahead[:, None])
    here = here & lasts[..., None, :]
    least, which = torch.where(here, x.abs()[..., None, :], math.inf).min(-1)

    def at(part: Tensor) -> Tensor:
        return part.expand(which.shape).gather(-1, which)

    near = (least - LENGTH / 2).nan_to_num(posinf=RANGE)
    return Memory(
        there=least.isfinite() & hidden(near) & (least < RANGE),
        x=at(x),
        y=at(memory.y),
        speed=at(memory.speed),
        sideways=torch.zeros_like(x),
        brakes=torch.zeros_like(memory.brakes),
        age=at(memory.age) + 1,
        own_speed=ego[..., 3:4],
    )


def _either(*memories: Memory) -> Memory:
    """Return for each direction the car of the first memory that has one."""
    found = memories[-1]
    for memory in reversed(memories[:-1]):
        there = memory.there
        found = Memory(
            **{
                name: torch.where(there, getattr(memory, name), getattr(found, name))
                for name in ("x", "y", "speed", "sideways", "brakes", "age")
            },
            there=there | found.there,
            own_speed=memory.own_speed,
        )
    return found

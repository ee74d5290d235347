"""Simulated drivers: what they know of cars around them, and what they do.

A driver knows the cars within reach, and those that were shown or spoken of. A car out of sight is
expected to drive on as it did for ``REMEMBERED`` decisions; of all else there is nothing, as far as
the driver knows. They plan in this world as the expert does in the true one, with a weight of their
own on coming near others and on accidents, and choose more or less consistently:

``p(a_t | m_t) = softmax(consistency * Q(., m_t))``

with ``Q(a, m_t)`` the return of keeping up manoeuvre ``a`` for six seconds among the cars known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain, Observation, Visibility, by_eye
from mirror_ppl.domains.highway import expert
from mirror_ppl.domains.highway.estimate import Cars, cars_in, state_with
from mirror_ppl.domains.highway.lidar import RANGE
from mirror_ppl.domains.highway.road import DECISION_TICKS, LENGTH, TICK, centre_of, lane_of
from mirror_ppl.domains.highway.speech import AHEAD, DIRECTIONS, NOTHING, SIDES, WORDS
from mirror_ppl.domains.highway.world import SIGHT_OF, Highway
from mirror_ppl.models.implants import ASSUMES, SIGHT
from mirror_ppl.people.base import SimulatedPeople

SECONDS = TICK * DECISION_TICKS
"""Seconds of a decision."""
REMEMBERED = 6
"""Decisions (3 s) for which a car out of sight is expected to drive on."""
HEARD_AT = (25.0, 20.0)
"""Metres at which drivers imagine a car ahead, and one behind, of which they are told."""
HEARD_FASTER = (5.0, 1.5, -5.0, -0.5, 2.0)
"""m/s at which its distance shrinks in their minds, by sentence."""
CAREFUL = ("front_proximity", "back_proximity", "near", "accident")
"""Terms of the reward that are weighted by a driver's caution."""


@dataclass(frozen=True)
class Memory(Cars):
    """The cars that drivers know of.

    Attributes:
        age: decisions since each was seen, shown or spoken of ``[..., 6]``.
        own_speed: the driver's own speed in m/s ``[...]`` at the last decision.
    """

    age: Tensor
    own_speed: Tensor


@dataclass(frozen=True)
class HighwayDrivers(SimulatedPeople):
    """P simulated drivers; step them with `step`.

    Attributes:
        reach: metres that each sees ``[P, 4]``, in each of ``Highway.directions``.
        consistency: ``[P]``, in 1 / units of reward.
        caution: weight ``[P]`` of ``CAREFUL`` terms, relative to the task's.
    """

    reach: Tensor
    consistency: Tensor
    caution: Tensor

    @property
    def domain(self) -> Domain:
        """World in which they act."""
        return Highway()

    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Memory:
        """Return memories before a round begins."""
        del mind_noise
        zero = self.reach.new_zeros(len(self.reach), *batch, len(DIRECTIONS))
        no = zero > 0
        return Memory(no, zero, zero, zero, zero, no, zero, zero[..., 0])

    def sees(self, observation: Observation) -> Visibility:
        """Return sectors within reach."""
        direction, distance = self.domain.distance(observation)
        people = torch.arange(len(self.reach), device=distance.device).view(
            -1, *(1,) * (distance.dim() - 1)
        )
        return by_eye(self.domain, distance <= self.reach[people, direction])

    @torch.no_grad()
    def step(
        self, memory: Memory, observation: Observation, told: Visibility | None = None
    ) -> tuple[Tensor, Memory]:
        """Look, listen, remember, and plan among the cars that are known."""
        seen = self.sees(observation)["visual"]
        heard = torch.zeros_like(memory.there)
        if told is not None:
            seen, heard = seen | told["visual"], heard | told["verbal"]
        memory = self.remember(memory, observation, seen, heard)
        state = state_with(observation["ego"], memory)
        lengths = (1,) * (memory.own_speed.dim() - 1)
        caution = self.caution.view(-1, *lengths).expand(memory.own_speed.shape)
        values = expert.values(state, weights=dict.fromkeys(CAREFUL, caution))
        return torch.softmax(self.consistency.view(-1, *lengths, 1) * values, -1), memory

    def remember(
        self, memory: Memory, observation: Observation, seen: Tensor, heard: Tensor
    ) -> Memory:
        """Return the memory after a look at sectors ``[..., 36]`` and sentences ``[..., 6]``."""
        ego = observation["ego"]
        visual = observation["visual"]
        nothing = visual.new_tensor([RANGE, 0.0, 0.0])
        said = torch.where(heard, observation["verbal"][..., 0], float(NOTHING))
        sight = cars_in(
            {
                "ego": ego,
                "visual": torch.where(seen[..., None], visual, nothing),
                "verbal": said[..., None],
            }
        )
        now = Memory(**vars(sight), age=torch.zeros_like(sight.x), own_speed=ego[..., 3])
        sentence = said.round().long()
        told = _told(ego, sentence)
        after = _either(now, told, _expected(memory, ego, self._limits(ego)))
        # Told that nothing is there, a driver forgets a car.
        empty = heard & (sentence == NOTHING)
        return replace(after, there=after.there & ~(empty & ~now.there))

    def _limits(self, ego: Tensor) -> Tensor:
        """Return the reach ``[P, ..., 6]`` in each direction of speech."""
        reach = self.reach[:, list(SIGHT_OF)]
        return reach.view(len(reach), *(1,) * (ego.dim() - 2), -1).expand(*ego.shape[:-1], -1)

    def truth(self) -> dict[str, Tensor]:
        """Return their sight thresholds, and that they take for granted what they do not see."""
        own = {SIGHT + name: self.reach[:, i] for i, name in enumerate(self.domain.directions)}
        return own | {ASSUMES + "clear": torch.ones_like(self.consistency)}


def _told(ego: Tensor, said: Tensor) -> Memory:
    """Return the cars ``[..., 6]`` that sentences are about, as drivers imagine them."""
    ahead = torch.tensor(AHEAD, device=ego.device)
    sides = torch.tensor(SIDES, device=ego.device)
    there = said < NOTHING
    faster = torch.tensor((*HEARD_FASTER, 0.0), dtype=ego.dtype, device=ego.device)[said]
    x = torch.where(ahead, HEARD_AT[0], -HEARD_AT[1]).to(ego).expand(said.shape)
    own = ego[..., 3]
    lane = ego[..., :1].round().long() + sides
    return Memory(
        there=there,
        x=x,
        y=centre_of(lane).to(ego),
        speed=(own[..., None] + torch.where(ahead, -faster, faster)).clamp(min=0),
        sideways=torch.zeros_like(x),
        brakes=there & (said == WORDS.index("braking")),
        age=torch.zeros_like(x),
        own_speed=own,
    )


def _expected(memory: Memory, ego: Tensor, reach: Tensor) -> Memory:
    """Return what is expected of remembered cars, in the directions in which they are now.

    A driver who looks where a car should be and does not see it forgets it, as does one who has not
    seen it for a while.
    """
    driven = SECONDS * (memory.own_speed + ego[..., 3]) / 2
    x = memory.x + SECONDS * memory.speed - driven[..., None]
    side = lane_of(memory.y) - ego[..., :1].round().long()
    ahead = torch.tensor(AHEAD, device=ego.device)
    sides = torch.tensor(SIDES, device=ego.device)
    lasts = memory.there & (memory.age + 1 <= REMEMBERED)
    # [..., direction, remembered car]
    here = (side[..., None, :] == sides[:, None]) & ((x >= 0)[..., None, :] == ahead[:, None])
    here = here & lasts[..., None, :]
    least, which = torch.where(here, x.abs()[..., None, :], math.inf).min(-1)

    def at(part: Tensor) -> Tensor:
        return part.gather(-1, which)

    return Memory(
        there=least.isfinite() & (least - LENGTH / 2 > reach) & (least < RANGE),
        x=at(x),
        y=at(memory.y),
        speed=at(memory.speed),
        sideways=torch.zeros_like(x),
        brakes=torch.zeros_like(memory.brakes),
        age=at(memory.age) + 1,
        own_speed=ego[..., 3],
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

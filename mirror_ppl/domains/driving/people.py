"""People who drive: what they remember, and how they decide (supplement, section B).

A person sees the cars within reach, remembers every car they have ever seen or been told of, plans
on what they know, and is consistent to some degree:

===================  ===========================================================================
``reach_d``          how far they see in direction d, in cells; the directions are those of
                     `mirror_ppl.domains.driving.Driving.directions`
``m_t``              what they know at step t: `Memory`
``Q(a, m_t)``        value of each action to somebody for whom the cars in ``m_t`` are all there are
``consistency``      how strongly values decide, in 1 / units of reward
===================  ===========================================================================

``p(a_t | m_t) = softmax(consistency * Q(., m_t))``

There are two kinds. `TaskDrivers` value actions exactly, by the task's own reward; they stand in
for the participants of the study. `PlanningDrivers` are the simulated agents that the supplement
makes from recordings: a reward learned from them, and the cross-entropy method to plan on it.

Choices that the supplement leaves open, with their reasons, are in ``docs/people.md``.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from mirror_ppl.cross_entropy import CrossEntropyOptions, best_sequences
from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.domains.driving.knowledge import ASSUMPTIONS
from mirror_ppl.domains.driving.maximum_entropy import LearnedReward
from mirror_ppl.domains.driving.world import (
    CAR_LANES,
    CARS,
    ROAD_END,
    Driving,
    DrivingState,
    known_car_values,
    lane_rewards,
)
from mirror_ppl.people.base import SimulatedPeople, each

HORIZON = 10
"""How many steps people look ahead."""
DISCOUNT = 0.9
"""Discount per step of people's planning."""


@dataclass(frozen=True)
class Memory:
    """What a driver knows of each car; K = 4 cars in the order of ``CARS``.

    Attributes:
        known: boolean ``[..., K]``: ever seen or told of. Other cars do not exist for the driver,
            and what the other fields say of them means nothing.
        position: cells ahead ``[..., K]``, negative behind, reckoned on from when last observed.
        speed: relative speed ``[..., K]`` in cells per step.
        assumed: boolean ``[..., K]``: the speed is an assumption, neither seen nor told.
        age: steps ``[..., K]`` since the car was last observed.
    """

    known: Tensor
    position: Tensor
    speed: Tensor
    assumed: Tensor
    age: Tensor

    @classmethod
    def empty(cls, batch: tuple[int, ...], device: torch.device | None = None) -> Memory:
        """Memory ``[*batch, K]`` at the start of a round, before anything is observed."""
        shape = (*batch, len(CARS))
        nothing = torch.zeros(shape, device=device)
        never = torch.zeros(shape, dtype=torch.bool, device=device)
        return cls(known=never, position=nothing, speed=nothing, assumed=never, age=nothing)

    @classmethod
    def stack(cls, memories: list[Memory], dim: int) -> Memory:
        """One memory of several, stacked along a new dimension."""
        parts = {
            field.name: torch.stack([getattr(memory, field.name) for memory in memories], dim)
            for field in fields(cls)
        }
        return cls(**parts)

    def canonical(self) -> Memory:
        """The same knowledge in one form: what means nothing is zero.

        A speed that is not an assumption came from two sights or from speech and is right, so how
        long ago that was no longer matters.
        """
        assumed = self.known & self.assumed
        return Memory(
            known=self.known,
            position=torch.where(self.known, self.position, 0.0),
            speed=torch.where(self.known, self.speed, 0.0),
            assumed=assumed,
            age=torch.where(assumed, self.age, 0.0),
        )

    def rows(self) -> Tensor:
        """Everything as whole numbers ``[..., 5 K]``, equal where knowledge is equal."""
        parts = (self.known, self.position, self.speed, self.assumed, self.age)
        return torch.cat([part.long() for part in parts], -1)


def in_sight(reach: Tensor, position: Tensor, lane: Tensor) -> Tensor:
    """Which cars at given places are within reach, boolean ``[..., K]``.

    Args:
        reach: cells ``[..., 4]`` for each of ``Driving.directions``; a car is seen at that distance
            and below, abreast counts as ahead, and 0 behind is to see nothing there.
        position: cells ahead ``[..., K]``.
        lane: the driver's lane ``[...]``.
    """
    offset = torch.tensor(CAR_LANES, device=lane.device) - lane[..., None]
    place = torch.stack([position, offset.to(position.dtype)], -1)
    direction, distance = Driving().distance({"visual": place})
    return distance <= reach.expand(*direction.shape).gather(-1, direction)


def remember(
    memory: Memory,
    observation: Observation,
    seen: Tensor,
    told: Visibility | None = None,
    reach: Tensor | None = None,
) -> Memory:
    """What a driver knows after one more step; everything is digested, nothing is forgotten.

    - A car that is seen, or shown as a visual message, gives its position. Observed before, its
      speed follows from the two positions. Otherwise it is assumed to come closer: -1 cell a step
      for a car ahead, +1 for one behind or abreast (one that came from ahead would have been seen
      there before).
    - A car that is spoken of gives its position and speed.
    - Any other known car is reckoned on with its speed. Where that was an assumption and the car
      should be in sight now but is not, the assumption was wrong: the car moves the other way.
    - A car beyond the visible road (at +-``ROAD_END`` cells) cannot be observed.

    Args:
        memory: of the step before, ``[..., K]``.
        observation: everything there is to observe now; items that are neither seen nor told are
            not used.
        seen: boolean ``[..., K]``, the cars that the driver sees.
        told: boolean ``[..., K]`` for each modality, the items that are communicated; none unless
            given.
        reach: how far the driver sees ``[..., 4]`` (see `in_sight`); without it, no assumption is
            ever found wrong.

    Returns:
        The memory ``[..., K]`` at this step.
    """
    ahead, heard = observation["visual"][..., 0], observation["verbal"]
    shown, spoken = (told["visual"], told["verbal"]) if told else (seen, torch.zeros_like(seen))
    observed = (seen | shown) & (ahead.abs() < ROAD_END)
    spoken = spoken & (heard[..., 0].abs() < ROAD_END)

    age = memory.age + 1
    position = memory.position + memory.speed
    last_observed = position - memory.speed * age
    speed, assumed = memory.speed, memory.assumed

    if reach is not None:
        lane = observation["ego"][..., 0].long()
        expected = in_sight(reach, position, lane) & (position.abs() < ROAD_END)
        wrong = memory.known & assumed & expected & ~observed & ~spoken
        speed = torch.where(wrong, -speed, speed)
        position = torch.where(wrong, last_observed + speed * age, position)
        assumed = assumed & ~wrong

    closing = torch.where(ahead > 0, -1.0, 1.0).to(speed.dtype)
    measured = (ahead - last_observed) / age
    speed = torch.where(observed, torch.where(memory.known, measured, closing), speed)
    position = torch.where(observed, ahead, position)
    assumed = torch.where(observed, ~memory.known, assumed)

    return Memory(
        known=memory.known | observed | spoken,
        position=torch.where(spoken, heard[..., 0], position),
        speed=torch.where(spoken, heard[..., 2], speed),
        assumed=assumed & ~spoken,
        age=torch.where(observed | spoken, 0.0, age),
    )


@dataclass(frozen=True)
class SimulatedDrivers(SimulatedPeople):
    """P people who drive, each with their own sight and consistency; step them with `step`.

    Attributes:
        reach: how far each sees, in cells, ``[P, 4]`` for each of ``Driving.directions``.
        consistency: ``[P]``, in 1 / units of reward.
    """

    reach: Tensor
    consistency: Tensor

    @property
    def domain(self) -> Driving:
        """Driving."""
        return Driving()

    def truth(self) -> dict[str, Tensor]:
        """Their sight in each direction, what they take for granted, and their consistency."""
        sight = zip(Driving.directions, self.reach.unbind(-1), strict=True)
        return {
            **{f"sight_{direction}": reach for direction, reach in sight},
            **{f"assumes_{name}": torch.ones_like(self.consistency) for name in ASSUMPTIONS},
            "consistency": self.consistency,
        }

    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Memory:
        """Memory ``[P, *batch, K]`` before a round begins; nothing in it is chance."""
        del mind_noise
        return Memory.empty((len(self.reach), *batch), self.reach.device)

    def sees(self, observation: Observation) -> Visibility:
        """What each sees by themselves, boolean ``[P, ..., K]`` for each modality.

        Args:
            observation: ``[P, ...]``, everything there is to observe.
        """
        ahead = observation["visual"][..., 0]
        lane = observation["ego"][..., 0].long()
        seen = in_sight(each(self.reach, ahead.dim() - 2), ahead, lane)
        return {"visual": seen, "verbal": torch.zeros_like(seen)}

    def step(
        self, memory: Memory, observation: Observation, told: Visibility | None = None
    ) -> tuple[Tensor, Memory]:
        """Look, listen, remember, plan.

        Args:
            memory: of the step before, ``[P, ..., K]``; `start` at the first step of a round.
            observation: ``[P, ...]``, everything there is to observe.
            told: boolean ``[P, ..., K]`` for each modality, the items communicated at this step.

        Returns:
            Probabilities of the actions ``[P, ..., A]`` and the memory at this step.
        """
        seen = self.sees(observation)["visual"]
        reach = each(self.reach, seen.dim() - 2)
        memory = remember(memory, observation, seen, told, reach)
        values = self.values(memory, observation["ego"][..., 0].long())
        consistency = each(self.consistency, values.dim() - 1)
        return (consistency * values).softmax(-1), memory

    @abstractmethod
    def values(self, memory: Memory, lane: Tensor) -> Tensor:
        """Value ``[..., A]`` of each action, in units of reward.

        Args:
            memory: what is known, ``[..., K]``.
            lane: the driver's lane ``[...]``.
        """


@dataclass(frozen=True)
class TaskDrivers(SimulatedDrivers):
    """The ground truth: people who value actions exactly, by the reward of the task."""

    def values(self, memory: Memory, lane: Tensor) -> Tensor:
        """Exact values ``[..., A]`` of the task for somebody who knows these cars only."""
        state = DrivingState(lane=lane, position=memory.position, speed=memory.speed)
        return known_car_values(state, memory.known, HORIZON, DISCOUNT)


@dataclass(frozen=True)
class PlanningDrivers(SimulatedDrivers):
    """The simulated people: the cross-entropy method on a learned reward.

    The value of an action is that of the best plan found which begins with it. Plans are searched
    with the same random numbers each time, so probabilities are a function of what is known.

    Attributes:
        reward: what they plan on.
        options: how hard they search.
        planning_seed: seed of the random numbers of the search.
    """

    reward: LearnedReward
    options: CrossEntropyOptions = CrossEntropyOptions()
    planning_seed: int = 0

    def values(self, memory: Memory, lane: Tensor) -> Tensor:
        """Values ``[..., A]`` of the best plans found, over the cars that are known."""
        device = lane.device
        rewards = lane_rewards(
            memory.position, memory.speed, memory.known, HORIZON, self.reward.car_weights(device)
        )
        discounts = DISCOUNT ** torch.arange(HORIZON, device=device)
        # A plan's value, taken apart into terms that one product with each plan gives: the road
        # travelled in the present lane, the gain of being in the other, and the switches.
        both = rewards * discounts[:, None]
        index = lane[..., None, None].expand(*both.shape[:-1], 1)
        here, there = both.gather(-1, index), both.gather(-1, 1 - index)
        gain = (there - here)[..., None, :, :]
        along = here.sum((-2, -1))[..., None, None]
        switch = (self.reward.switch * discounts)[:, None]

        def value(plans: Tensor) -> Tensor:
            switches = plans.to(rewards.dtype)
            away = switches.cumsum(-1) % 2
            return along + (away @ gain + switches @ switch).squeeze(-1)

        batch = (*lane.shape, len(Driving.actions))
        generator = torch.Generator(device).manual_seed(self.planning_seed)
        begins = torch.arange(batch[-1], device=device).bool().expand(batch)
        return best_sequences(value, batch, HORIZON, generator, self.options, begins)[1]

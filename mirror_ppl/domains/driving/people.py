"""Simulated drivers: their memory and decisions (supplement, section B).

A person sees the cars within reach, remembers every car that was seen or communicated, plans with
this knowledge, and chooses more or less consistently:

===================  ===========================================================================
``reach_d``          how far they see in direction d, in cells; the directions are those of
                     `mirror_ppl.domains.driving.Driving.directions`
``m_t``              what they know at step t: `Memory`
``Q(a, m_t)``        value of each action if there are no other cars than those in ``m_t``
``consistency``      how strongly values decide, in 1 / units of reward
===================  ===========================================================================

``p(a_t | m_t) = softmax(consistency * Q(., m_t))``

There are two kinds. `TaskDrivers` value actions exactly, by the task's own reward; they stand in
for the participants of the study. `PlanningDrivers` are the supplement's simulated agents: they
plan by the cross-entropy method on a reward learned from recordings.

Choices that the supplement does not specify, and their reasons, are in ``docs/people.md``.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from mirror_ppl.cross_entropy import CrossEntropyOptions, best_sequences
from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.domains.driving.cars import CAR_LANES, CARS, DrivingState
from mirror_ppl.domains.driving.knowledge import ASSUMPTIONS, ROAD_END
from mirror_ppl.domains.driving.maximum_entropy import LearnedReward
from mirror_ppl.domains.driving.rewards import known_car_values, lane_rewards
from mirror_ppl.domains.driving.world import Driving
from mirror_ppl.people.base import SimulatedPeople, each

HORIZON = 10
"""Number of steps that people plan ahead."""
DISCOUNT = 0.9
"""Discount per step of people's planning."""


@dataclass(frozen=True)
class Memory:
    """A driver's knowledge of each car; K = 4 cars in the order of ``CARS``.

    Attributes:
        known: boolean ``[..., K]``: ever seen or communicated. Other cars do not exist for the
            driver, and their other fields are meaningless.
        position: cells ahead ``[..., K]``, negative behind, extrapolated since last observed.
        speed: relative speed ``[..., K]`` in cells per step.
        assumed: boolean ``[..., K]``: the speed is an assumption, neither seen nor communicated.
        age: steps ``[..., K]`` since the car was last observed.
    """

    known: Tensor
    position: Tensor
    speed: Tensor
    assumed: Tensor
    age: Tensor

    @classmethod
    def empty(cls, batch: tuple[int, ...], device: torch.device | None = None) -> Memory:
        """Return memory ``[*batch, K]`` at the start of a round, before any observation."""
        shape = (*batch, len(CARS))
        nothing = torch.zeros(shape, device=device)
        never = torch.zeros(shape, dtype=torch.bool, device=device)
        return cls(known=never, position=nothing, speed=nothing, assumed=never, age=nothing)

    @classmethod
    def stack(cls, memories: list[Memory], dim: int) -> Memory:
        """Stack several memories along a new dimension."""
        parts = {
            field.name: torch.stack([getattr(memory, field.name) for memory in memories], dim)
            for field in fields(cls)
        }
        return cls(**parts)

    def canonical(self) -> Memory:
        """Return the memory with meaningless fields set to zero.

        A speed that is not an assumption came from two sights or an utterance and is correct, so
        its age is irrelevant.
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
        """Return all fields as whole numbers ``[..., 5 K]``, equal where knowledge is equal."""
        parts = (self.known, self.position, self.speed, self.assumed, self.age)
        return torch.cat([part.long() for part in parts], -1)


def in_sight(reach: Tensor, position: Tensor, lane: Tensor) -> Tensor:
    """Return which cars at given positions are within reach, boolean ``[..., K]``.

    Args:
        reach: cells ``[..., 4]`` for each of ``Driving.directions``; a car is seen at that distance
            and below, abreast counts as ahead, and 0 behind means no sight there.
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
    """Update a driver's memory by one step; nothing is forgotten.

    - For a car that is seen, or shown as a visual message, the position is known. If the car was
      observed before, its speed follows from the two positions. Otherwise it is assumed to come
      closer: -1 cell a step for a car ahead, +1 for a car behind or abreast (from ahead it would
      have been seen there before).
    - For a car in a verbal message, position and speed are known.
    - The position of any other known car is extrapolated with its speed. If that was an assumption
      and the car should be in sight but is not, the car moves the other way.
    - A car beyond the visible road (at +-``ROAD_END`` cells) cannot be observed.

    Args:
        memory: of the step before, ``[..., K]``.
        observation: full observation; items that are neither seen nor communicated are not used.
        seen: boolean ``[..., K]``, the cars that the driver sees.
        told: boolean ``[..., K]`` for each modality, the items that are communicated; none unless
            given.
        reach: how far the driver sees ``[..., 4]`` (see `in_sight`); without it, assumptions are
            never corrected.

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
    """P simulated drivers, each with their own sight and consistency; step them with `step`.

    Attributes:
        reach: how far each sees, in cells, ``[P, 4]`` for each of ``Driving.directions``.
        consistency: ``[P]``, in 1 / units of reward.
    """

    reach: Tensor
    consistency: Tensor

    @property
    def domain(self) -> Driving:
        """Driving domain."""
        return Driving()

    def truth(self) -> dict[str, Tensor]:
        """Return their sight in each direction, assumptions and consistency."""
        sight = zip(Driving.directions, self.reach.unbind(-1), strict=True)
        return {
            **{f"sight_{direction}": reach for direction, reach in sight},
            **{f"assumes_{name}": torch.ones_like(self.consistency) for name in ASSUMPTIONS},
            "consistency": self.consistency,
        }

    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Memory:
        """Return memories ``[P, *batch, K]`` before a round begins; they are deterministic."""
        del mind_noise
        return Memory.empty((len(self.reach), *batch), self.reach.device)

    def sees(self, observation: Observation) -> Visibility:
        """Return items each sees without messages, boolean ``[P, ..., K]`` by modality.

        Args:
            observation: full observation, ``[P, ...]``.
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
            observation: full observation, ``[P, ...]``.
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
        """Return values ``[..., A]`` of actions, in units of reward.

        Args:
            memory: knowledge of cars, ``[..., K]``.
            lane: the driver's lane ``[...]``.
        """


@dataclass(frozen=True)
class TaskDrivers(SimulatedDrivers):
    """Ground-truth drivers, who value actions exactly, by the reward of the task."""

    def values(self, memory: Memory, lane: Tensor) -> Tensor:
        """Return exact values ``[..., A]`` of the task if there are only the known cars."""
        state = DrivingState(lane=lane, position=memory.position, speed=memory.speed)
        return known_car_values(state, memory.known, HORIZON, DISCOUNT)


@dataclass(frozen=True)
class PlanningDrivers(SimulatedDrivers):
    """Simulated drivers, who plan by the cross-entropy method on a learned reward.

    The value of an action is that of the best plan found that begins with it. Plans are searched
    with the same random numbers each time, so probabilities are a function of knowledge.

    Attributes:
        reward: the learned reward.
        options: of the cross-entropy method.
        planning_seed: seed of the random numbers of the search.
    """

    reward: LearnedReward
    options: CrossEntropyOptions = CrossEntropyOptions()
    planning_seed: int = 0

    def values(self, memory: Memory, lane: Tensor) -> Tensor:
        """Return values ``[..., A]`` of the best plans found, given the known cars."""
        device = lane.device
        rewards = lane_rewards(
            memory.position, memory.speed, memory.known, HORIZON, self.reward.car_weights(device)
        )
        discounts = DISCOUNT ** torch.arange(HORIZON, device=device)
        # A plan's value is linear in three terms: the return of the present lane, the gain of
        # being in the other lane, and the switches.
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

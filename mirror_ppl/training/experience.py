"""Experience of the robot: rounds that it drove, and the outcomes of every action.

Only the initial states and the actions of rounds are stored, unless a `Course` is kept, which
worlds with slow transitions need. Transitions are functions of state and action, so observations,
views and rewards are recomputed whenever a round is used for training.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains.base import (
    Domain,
    Observation,
    Visibility,
    map_state,
    roll_out,
    total_reward,
)
from mirror_ppl.domains.world import World
from mirror_ppl.models.self_model import Rounds, SelfModel
from mirror_ppl.training.views import ViewPlan


@dataclass(frozen=True)
class Course:
    """Rounds and what happened in them, which takes long to compute in some worlds.

    Attributes:
        actions: ``[B, T]``.
        states: ``[B, T + 1]``.
        observation: full observations ``[B, T + 1, ...]``.
        rewards: of the actions ``[B, T]``.
        values: the planner's action values ``[B, T, A]``, if they are learned; nan where they are
            unknown, so that nothing is learned there.
        believed: rounds ``[B]`` that are as they were believed; none of them unless given.
        taken: in these, the items ``[B, T + 1, K]`` that were seen, heard or taken for granted;
            the other rounds may be seen through any view.
    """

    actions: Tensor
    states: Any
    observation: Observation
    rewards: Tensor
    values: Tensor | None = None
    believed: Tensor | None = None
    taken: Visibility | None = None

    @classmethod
    def of(cls, domain: Domain, start: Any, actions: Tensor) -> Course:
        """Return the course of rounds from ``start`` ``[B]`` by ``actions`` ``[B, T]``."""
        states = roll_out(domain, start, actions)
        before, after = (
            map_state(lambda part: part[:, steps], states)  # noqa: B023 - used at once
            for steps in (slice(None, -1), slice(1, None))
        )
        rewards = total_reward(domain.rewards(before, actions, after))
        return cls(actions, states, domain.observe(states), rewards)

    @classmethod
    def join(cls, courses: Sequence[Course]) -> Course:
        """Return the rounds of several courses, all of them with values or all without."""
        first, *others = courses
        if not others:
            return first

        def joined(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
            return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}

        values = [one.values for one in courses if one.values is not None]
        believed = [one.believed for one in courses if one.believed is not None]
        taken = [one.taken for one in courses if one.taken is not None]
        return cls(
            torch.cat([one.actions for one in courses]),
            map_state(lambda *parts: torch.cat(parts), *(one.states for one in courses)),
            joined([one.observation for one in courses]),
            torch.cat([one.rewards for one in courses]),
            torch.cat(values) if values else None,
            torch.cat(believed) if believed else None,
            joined(taken) if taken else None,
        )

    def window(self, rows: Tensor, begin: int, steps: int) -> Course:
        """Return some of these rounds, from a step on."""
        end = begin + steps

        def cut(parts: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {name: part[rows, begin : end + 1] for name, part in parts.items()}

        return Course(
            self.actions[rows, begin:end],
            map_state(lambda part: part[rows, begin : end + 1], self.states),
            cut(self.observation),
            self.rewards[rows, begin:end],
            None if self.values is None else self.values[rows, begin:end],
            None if self.believed is None else self.believed[rows],
            None if self.taken is None else cut(self.taken),
        )

    def supposed_by(self, domain: Domain, plan: ViewPlan) -> Course:
        """Return these rounds as observers who make assumptions believed them to be.

        Args:
            domain: the world.
            plan: views of these rounds; those in which nothing is assumed stay as they are.
        """
        return _seen_by(domain, plan, self)[0]

    def reflected(self, domain: World) -> Course:
        """Return the mirror images of these rounds, in a world that equals its mirror image."""
        states = domain.reflected(self.states)
        image = torch.tensor(domain.reflected_actions, device=self.actions.device)
        observation = domain.observe(states)
        values = None if self.values is None else self.values[..., image]
        taken = self.taken and {
            name: mask[..., domain.reflected_items[name]] for name, mask in self.taken.items()
        }
        return Course(
            image[self.actions], states, observation, self.rewards, values, self.believed, taken
        )


def _but_last(states: Any) -> Any:
    return map_state(lambda part: part[:, :-1], states)


@dataclass(frozen=True)
class Outcomes:
    """Outcomes of one action at some steps, to the best knowledge of the observer.

    Attributes:
        reward: ``[B, T']``.
        over: True if no further reward is possible after the action ``[B, T']``.
        observation: the next observation ``[B, T', ...]``.
        visible: the items of it that the observer would see ``[B, T', K]``.
    """

    reward: Tensor
    over: Tensor
    observation: Observation
    visible: Visibility


@dataclass(frozen=True)
class Experience:
    """Rounds under a view, with the outcomes of every action at some steps.

    Attributes:
        rounds: observations, actions and rewards.
        outcomes: one entry for each action.
        over: True if no further reward is possible, at these steps ``[B, T']``.
        informed: True if the observer knows all decisive items there ``[B, T']``.
        exact: action values for an observer who knows them, if requested, ``[B, T', A]``.
        first: first step with outcomes.
        stride: distance between these steps.
    """

    rounds: Rounds
    outcomes: tuple[Outcomes, ...]
    over: Tensor
    informed: Tensor
    exact: Tensor | None = None
    first: int = 0
    stride: int = 1

    @property
    def steps(self) -> slice:
        """Steps of the rounds that have outcomes."""
        return slice(self.first, None, self.stride)


def experience(
    domain: Domain,
    course: Course,
    plan: ViewPlan,
    first: int = 0,
    stride: int = 1,
    discount: float | None = None,
) -> Experience:
    """Compute the experience of an observer with a view.

    If the observer makes assumptions, the world is replaced by the world as they believe it to be,
    so the networks learn from observations, rewards and outcomes of that believed world.

    Args:
        domain: the world.
        course: rounds; with values, no outcomes are computed.
        plan: views of these rounds.
        first: first step at which the outcomes of every action are computed.
        stride: distance between these steps.
        discount: discount of exact values, which are computed only if it is given.
    """
    values, actions = course.values, course.actions
    lived, knowledge = _seen_by(domain, plan, course)
    observation, visible = lived.observation, lived.taken or {}
    steps = slice(first, actions.shape[1], stride)
    some, known = (
        map_state(lambda part: part[:, steps], _but_last(whole))
        for whole in (lived.states, knowledge)
    )
    outcomes = ()
    if values is None:
        outcomes = _outcomes(domain, plan, some, known, 1 + first, stride)
    if course.believed is not None and course.taken is not None:
        believes = course.believed[:, None, None]
        visible = {
            name: torch.where(believes, course.taken[name], mask) for name, mask in visible.items()
        }
    informed = torch.stack(
        [(visible[name] | ~needed).all(-1) for name, needed in domain.decisive(observation).items()]
    ).all(0)
    over, exact = domain.over(some), _exact(domain, some, discount)
    if values is not None:
        exact = values[:, steps]
        over = over | exact.isnan().any(-1)
    return Experience(
        rounds=Rounds(
            observation=observation,
            visible=visible,
            actions=actions,
            rewards=lived.rewards,
        ),
        outcomes=outcomes,
        over=over,
        exact=exact,
        informed=informed[:, steps],
        first=first,
        stride=stride,
    )


def _seen_by(domain: Domain, plan: ViewPlan, course: Course) -> tuple[Course, Any]:
    """Return rounds as their observers see or believe them, and what these know ``[B, T + 1]``."""
    visible, knowledge = follow(domain, plan, course.observation)
    assuming = torch.zeros_like(plan.remembers)
    for makes in plan.assumes.values():
        assuming = assuming | makes
    if assuming.any():  # the world is not as believed
        states = supposed(domain, plan, course.states, knowledge)
        observation, now = domain.observe(states), _but_last(states)
        taken = plan.taken(domain, knowledge, observation)
        visible = {name: mask | taken[name] for name, mask in visible.items()}
        later = domain.transition(now, course.actions)
        earned = total_reward(domain.rewards(now, course.actions, later))
        rewards = torch.where(assuming[:, None], earned, course.rewards)
        course = replace(course, states=states, observation=observation, rewards=rewards)
    return replace(course, believed=assuming, taken=visible), knowledge


def _exact(domain: Domain, states: Any, discount: float | None) -> Tensor | None:
    return None if discount is None else domain.reference_values(states, discount)


def _outcomes(
    domain: Domain, plan: ViewPlan, states: Any, knowledge: Any, first: int, stride: int
) -> tuple[Outcomes, ...]:
    """Return the outcomes of each action in states ``[B, T']``.

    Args:
        domain: the world.
        plan: views of B rounds.
        states: as believed.
        knowledge: in these states.
        first: step after the first of these states.
        stride: distance between their steps.
    """
    # All actions at once, as worlds may take many small steps.
    number = len(domain.actions)
    batch = map_state(lambda part: part.repeat(number, *(1,) * (part.dim() - 1)), states)
    over = domain.over(states)
    each = torch.arange(number, device=over.device).repeat_interleave(len(over))
    tried = each[:, None].expand(-1, over.shape[1])
    following = domain.transition(batch, tried)
    earned = total_reward(domain.rewards(batch, tried, following)).chunk(number)
    ends, observed = domain.over(following).chunk(number), domain.observe(following)
    outcomes = []
    for action, (reward, end) in enumerate(zip(earned, ends, strict=True)):
        now = {name: value.chunk(number)[action] for name, value in observed.items()}
        visible, after = plan.look(domain, knowledge, now, first, stride)
        taken = plan.taken(domain, after, now)
        visible = {name: mask | taken[name] for name, mask in visible.items()}
        outcomes.append(Outcomes(reward, end, now, visible))
    return tuple(outcomes)


def follow(domain: Domain, plan: ViewPlan, observation: Observation) -> tuple[Visibility, Any]:
    """Visibility of rounds ``[B, T + 1, K]``, and the knowledge at each step ``[B, T + 1]``."""
    batch, steps = observation["ego"].shape[:2]
    knowledge = domain.nothing_known(batch, 1, device=observation["ego"].device)
    looks = []
    for step in range(steps):
        now = {name: value[:, step : step + 1] for name, value in observation.items()}
        visible, knowledge = plan.look(domain, knowledge, now, step)
        looks.append((visible, knowledge))
    return (
        {name: torch.cat([visible[name] for visible, _ in looks], 1) for name in looks[0][0]},
        map_state(lambda *parts: torch.cat(parts, 1), *(after for _, after in looks)),
    )


def supposed(domain: Domain, plan: ViewPlan, states: Any, knowledge: Any) -> Any:
    """States ``[B, T']`` as the observers believe them to be."""
    assumes = {name: makes[:, None] for name, makes in plan.assumes.items()}
    return domain.supposed(states, knowledge, assumes)


@torch.no_grad()
def drive(
    self_model: SelfModel,
    start: Any,
    plan: ViewPlan,
    steps: int,
    generator: torch.Generator,
    epsilon: float = 0.0,
    expert: float = 0.0,
    discount: float = 0.9,
) -> Tensor:
    """Drive rounds that the robot sees through a view, and return the actions ``[B, T]``.

    Args:
        self_model: its greedy policy drives.
        start: states ``[B]``.
        plan: views of B rounds.
        steps: number of actions T.
        generator: source of randomness.
        epsilon: probability of a random action instead of the greedy one.
        expert: share of rounds driven by the exact planner, which knows everything.
        discount: discount of the exact planner.
    """
    domain = self_model.domain
    batch = len(plan.remembers)
    device = generator.device
    by_expert = torch.rand(batch, generator=generator, device=device) < expert
    belief = torch.zeros(batch, self_model.latent, device=device)
    previous = torch.full((batch,), len(domain.actions), device=device)
    knowledge = domain.nothing_known(batch, 1, device=device)
    state, actions = start, []
    for step in range(steps):
        now = map_state(lambda part: part[:, None], state)
        visible, knowledge = plan.look(domain, knowledge, domain.observe(now), step)
        observation = domain.observe(supposed(domain, plan, now, knowledge))
        taken = plan.taken(domain, knowledge, observation)
        visible = {name: mask | taken[name] for name, mask in visible.items()}
        evidence = self_model.encoder.evidence(domain.symbols(observation), visible)[:, 0]
        evidence = evidence + self_model.encoder.action(previous)
        belief = self_model.encoder(belief, evidence).mean
        action = self_model.action_values(belief).argmax(-1)
        if by_expert.any():
            led = map_state(lambda part: part[by_expert], state)
            action = action.index_put(
                (by_expert,), domain.reference_values(led, discount).argmax(-1)
            )
        if epsilon > 0:
            lost = torch.rand(batch, generator=generator, device=device) < epsilon
            anything = torch.randint(
                len(domain.actions), (batch,), generator=generator, device=device
            )
            action = torch.where(lost & ~by_expert, anything, action)
        actions.append(action)
        previous = action
        state = domain.transition(state, action)
    return torch.stack(actions, 1)

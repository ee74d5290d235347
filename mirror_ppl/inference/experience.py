"""Experience of the robot: rounds it drove, and what each action would have led to.

Experience is kept as where rounds began and what was done in them; the world is deterministic from
there on, so observations, views and rewards are made again whenever a round is learned from.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain, Observation, Visibility, total_reward
from mirror_ppl.models.self_model import Rounds, SelfModel
from mirror_ppl.models.views import ViewPlan


@dataclass(frozen=True)
class Outcomes:
    """What one action would lead to at each step, to the best knowledge of the observer.

    Attributes:
        reward: ``[B, T]``.
        observation: the next observation ``[B, T, ...]``.
        visible: what the observer would see of it ``[B, T, K]``.
    """

    reward: Tensor
    observation: Observation
    visible: Visibility


@dataclass(frozen=True)
class Experience:
    """Rounds under a view: what happened, and the outcomes of every action at every step."""

    rounds: Rounds
    outcomes: tuple[Outcomes, ...]


def map_state(function: Any, *states: Any) -> Any:
    """Apply a function to each tensor of one or several states of a domain."""
    kind = type(states[0])
    return kind(
        **{
            field.name: function(*(getattr(state, field.name) for state in states))
            for field in fields(kind)
        }
    )


def roll_out(domain: Domain, start: Any, actions: Tensor) -> Any:
    """States ``[B, T + 1]`` of rounds from ``start`` ``[B]`` under ``actions`` ``[B, T]``."""
    states = [start]
    for action in actions.unbind(1):
        states.append(domain.transition(states[-1], action))
    return map_state(lambda *parts: torch.stack(parts, 1), *states)


def experience(domain: Domain, start: Any, actions: Tensor, plan: ViewPlan) -> Experience:
    """What an observer with a view gets from rounds.

    A credulous observer's world holds nothing that they have not seen or been told of, so neither
    do the observations, rewards and outcomes from which the networks learn to think like them.

    Args:
        domain: the world.
        start: states ``[B]``.
        actions: ``[B, T]``.
        plan: views of B rounds.
    """
    states = roll_out(domain, start, actions)
    seen = plan.visibility(domain, domain.observe(states))
    unknown = domain.unknown_so_far(seen)["visual"] & plan.credulous[:, None, None]
    believed = domain.remove(states, unknown)
    before, unknown_before = map_state(lambda part: part[:, :-1], states), unknown[:, :-1]
    current = map_state(lambda part: part[:, :-1], believed)

    def outcome(action: Tensor) -> Outcomes:
        following = domain.remove(domain.transition(before, action), unknown_before)
        observation = domain.observe(following)
        visible = plan.visibility(domain, observation, first=1)
        return Outcomes(
            reward=total_reward(domain.rewards(current, action, following)),
            observation=observation,
            visible=_imagine_absent(visible, unknown_before),
        )

    taken = domain.remove(map_state(lambda part: part[:, 1:], states), unknown_before)
    return Experience(
        rounds=Rounds(
            observation=domain.observe(believed),
            visible=_imagine_absent(seen, unknown),
            actions=actions,
            rewards=total_reward(domain.rewards(current, actions, taken)),
        ),
        outcomes=tuple(
            outcome(torch.full_like(actions, index)) for index in range(len(domain.actions))
        ),
    )


def _imagine_absent(seen: Visibility, unknown: Tensor) -> Visibility:
    """Unknown items count as seen: their observation says that nothing is there."""
    return {
        name: (mask & ~unknown) | (unknown if name == "visual" else False)
        for name, mask in seen.items()
    }


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
    """Actions ``[B, T]`` of the robot in rounds that it sees through a view.

    Args:
        self_model: whose greedy policy drives.
        start: states ``[B]``.
        plan: views of B rounds.
        steps: number of actions T.
        generator: source of randomness.
        epsilon: probability of a random action instead of the greedy one.
        expert: share of rounds driven by the exact planner, which knows everything.
        discount: discount of the exact planner.
    """
    domain = self_model.domain
    batch = len(plan.credulous)
    device = generator.device
    by_expert = torch.rand(batch, generator=generator, device=device) < expert
    belief = torch.zeros(batch, self_model.latent, device=device)
    previous = torch.full((batch,), len(domain.actions), device=device)
    unknown = torch.ones(batch, 1, len(domain.modalities[0].items), device=device).bool()
    state, actions = start, []
    for step in range(steps):
        observation = {name: value[:, None] for name, value in domain.observe(state).items()}
        seen = plan.visibility(domain, observation, first=step)
        unknown = unknown & domain.unknown_so_far(seen)["visual"]
        imagined = unknown & plan.credulous[:, None, None]
        believed = domain.remove(map_state(lambda part: part[:, None], state), imagined)
        embedded = self_model.encoder.embed(domain.symbols(domain.observe(believed)))
        evidence = self_model.encoder.combine(embedded, _imagine_absent(seen, imagined))[:, 0]
        evidence = evidence + self_model.encoder.action(previous)
        belief = self_model.encoder(belief, evidence).mean
        action = self_model.action_values(belief).argmax(-1)
        if expert > 0:
            best = domain.reference_values(state, discount).argmax(-1)
            action = torch.where(by_expert, best, action)
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

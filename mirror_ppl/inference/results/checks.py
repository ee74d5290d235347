"""Posterior predictive checks of a person's actions.

A posterior can be narrow although its model is wrong. Recorded actions are therefore compared with
actions drawn from the posterior predictive, step by step given all earlier recorded steps::

    T_h = 1/N sum_t f_h(a_t; history before t)            of the recorded actions
    T_h^rep                                                of actions drawn from the posterior
                                                           predictive at the same steps
    p_h = P(T_h^rep > T_h) + 1/2 P(T_h^rep = T_h)

(Gelman, Meng and Stern, 1996). Each step is drawn given the recorded ones before it, so no round
has to be simulated, and a check does not depend on later actions. Only training rounds are used:
since the posterior is given these, p-values are conservative, whereas under a wide posterior every
held-out round would seem surprising.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains.base import FUTURES, Domain, map_state, total_reward
from mirror_ppl.inference.results.summary import predictive

REPLICATES = 2000
"""Replicated recordings of a person: the standard error of a p-value of 0.005 is 0.0016."""

TIE = 1e-6
"""Relative tolerance for rounding in sums."""
SHARE = "share of "
"""Prefix of the names of checks of action shares."""


@dataclass(frozen=True)
class Steps:
    """The N recorded steps of one person, in order.

    Attributes:
        actions: recorded actions ``[N]``.
        log_probability: log-probability of each action there, under each draw ``[S, N, A]``.
        before: number of the step before it in the same round, or -1, ``[N]``.
        rewards: expected reward of each action there, ``[N, A]``.
    """

    actions: Tensor
    log_probability: Tensor
    before: Tensor
    rewards: Tensor

    @property
    def follows(self) -> Tensor:
        """Steps ``[n]`` that are not the first of their round."""
        return (self.before >= 0).nonzero().squeeze(-1)


@dataclass(frozen=True)
class Check:
    """A statistic of recorded actions that is compared with its posterior predictive.

    Attributes:
        name: name of the statistic.
        of: its value for each action at each step, ``[S, n, A]`` or ``[1, n, A]``: at all N steps
            or, if n < N, at those that are not the first of their round.
        more: description of a person whose statistic is larger than the model predicts.
        less: description of a person whose statistic is smaller.
    """

    name: str
    of: Callable[[Steps], Tensor]
    more: str
    less: str


def switches(steps: Steps) -> Tensor:
    """1 for actions that differ from that of the step before, ``[1, n, A]``."""
    some = steps.follows
    last = steps.actions[steps.before[some]]
    actions = torch.arange(steps.rewards.shape[-1], device=last.device)
    return (actions != last[:, None]).to(steps.rewards)[None]


def delayed(steps: Steps) -> Tensor:
    """Predictive probability of an action at the step before, ``[1, n, A]``."""
    return predictive(steps.log_probability).exp()[steps.before[steps.follows]][None]


def reward(steps: Steps) -> Tensor:
    """Immediate reward of an action ``[1, N, A]``; collisions, wrong buttons etc. cost."""
    return steps.rewards[None]


def surprise(steps: Steps) -> Tensor:
    """``-log p(a)``, ``[S, N, A]``; on average the actions' entropy if the model is right."""
    return -steps.log_probability


CHECKS: Mapping[str, Check] = {
    check.name: check
    for check in (
        Check(
            "delayed",
            delayed,
            "acts as if one step late",
            "reacts sooner than the model says",
        ),
        Check(
            "switches",
            switches,
            "changes what they do more often than the model says",
            "changes what they do less often than the model says",
        ),
        Check(
            "reward",
            reward,
            "earns more than the model says",
            "earns less than the model says",
        ),
        Check(
            "surprise",
            surprise,
            "is less predictable than the model says",
            "is more predictable than the model says",
        ),
    )
}
"""Registry of checks besides the shares of actions; a new check is one more entry."""

ONE_SIDED: Mapping[str, str] = {
    "missed": "is better explained by noticing late, or missing, what the model says they see",
    "forgot": "is better explained by forgetting earlier steps",
}
"""Checks of perception, with descriptions of people whose p-value is small; large ones say nothing.
"""


def steps_of(domain: Domain, rounds: Demonstrations, log_probability: Tensor) -> Steps:
    """The recorded steps of one person.

    Args:
        domain: the world.
        rounds: rounds of one person.
        log_probability: log-probabilities of actions ``[S, 1, B, T, A]``.
    """
    real = rounds.mask[0]
    number = torch.full(real.shape, -1, device=real.device)
    number[real] = torch.arange(int(real.sum()), device=real.device)
    before = torch.cat([torch.full_like(number[:, :1], -1), number[:, :-1]], 1)
    now = {name: value[0, :, : real.shape[1]][real] for name, value in rounds.observation().items()}
    state, actions = domain.state_behind(now), len(domain.actions)
    each = map_state(lambda part: part.repeat_interleave(actions, 0), state)
    action = torch.arange(actions, device=real.device).repeat(int(real.sum()))
    chance = torch.Generator(real.device).manual_seed(0)
    futures = FUTURES if domain.random else 1
    earned = torch.zeros(len(action), device=real.device)
    for _ in range(futures):
        each = domain.redrawn(each, chance)
        following = domain.transition(each, action)
        earned += total_reward(domain.rewards(each, action, following)) / futures
    return Steps(
        rounds.actions[0][real],
        log_probability[:, 0][:, real],
        before[real],
        earned.view(-1, actions).to(log_probability),
    )


def tail(name: str, p_value: float) -> float:
    """Return the p-value by which a check is judged: two-sided but for `ONE_SIDED` ones."""
    return p_value if name in ONE_SIDED else 2 * min(p_value, 1 - p_value)


def p_values(steps: Steps, actions: Sequence[str], generator: torch.Generator) -> dict[str, float]:
    """Posterior predictive p-value of each check, with equally many replicates per draw.

    Near 0 the statistic is larger than the model predicts, near 1 smaller. Each action's share is a
    check, too. Empty without recorded steps.
    """
    if not len(steps.actions):
        return {}
    draws, number, _ = steps.log_probability.shape
    times = -(-REPLICATES // draws)
    drawn = torch.multinomial(
        steps.log_probability.exp().flatten(0, 1), times, replacement=True, generator=generator
    ).view(draws, number, times)
    found = {}
    for name, check in CHECKS.items():
        values = check.of(steps)
        some = steps.follows if values.shape[1] < number else torch.arange(number)
        if not len(some):
            continue
        values = values.expand(draws, -1, -1)
        own = steps.actions[some][None, :, None].expand(draws, -1, 1)
        found[name] = more_often(
            values.gather(-1, drawn[:, some]).double().sum(1),
            values.gather(-1, own).double().sum(1),
        )
    # With two actions, the share of one determines the other.
    for action, name in enumerate(actions if len(actions) > 2 else actions[:1]):  # noqa: PLR2004
        found[SHARE + name] = more_often(
            (drawn == action).double().sum(1), (steps.actions == action).double().sum()
        )
    return found


def more_often(replicated: Tensor, recorded: Tensor) -> float:
    """Return how often replicates exceed the recorded value, with ties counted by half."""
    near = (replicated - recorded).abs() <= TIE * (1 + recorded.abs())
    # Actions of probability 0 have infinite surprise.
    same = torch.where(recorded.isfinite(), near, replicated == recorded)
    above = (replicated > recorded) & ~same
    return float((above.double() + same.double() / 2).mean())

"""Posterior predictive checks: what a person did, beside what the human model says they would do.

A posterior is sure of itself whether or not its model is right. What was done is therefore compared
with what the model says would be done, step by step given all that was recorded before::

    T_h = 1/N sum_t f_h(a_t; history before t)            of the recorded actions
    T_h^rep                                                of actions drawn from the posterior
                                                           predictive at the same steps
    p_h = P(T_h^rep > T_h) + 1/2 P(T_h^rep = T_h)

(Gelman, Meng and Stern, 1996). As each step is drawn given the recorded ones before it, no round
has to be simulated, and a check depends on nothing that was done later. Only rounds that were
learned from count: draws of the posterior are right given these, and p-values are then cautious,
while a wide posterior would be found surprised by every other round.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains.base import Domain, map_state, total_reward
from mirror_ppl.inference.results.summary import predictive

REPLICATES = 2000
"""Replicated recordings of a person: p-values of .005 are known to within .0016."""

TIE = 1e-6
"""Share of a sum that rounding may change."""
SHARE = "share of "
"""What the name of an action's share begins with."""


@dataclass(frozen=True)
class Steps:
    """The N recorded steps of one person, in order.

    Attributes:
        actions: what was done ``[N]``.
        log_probability: of each action there, under each draw ``[S, N, A]``.
        before: number of the step before it in the same round, or -1, ``[N]``.
        rewards: expected of each action there, ``[N, A]``.
    """

    actions: Tensor
    log_probability: Tensor
    before: Tensor
    rewards: Tensor

    @property
    def follows(self) -> Tensor:
        """Steps ``[n]`` that have one before them."""
        return (self.before >= 0).nonzero().squeeze(-1)


@dataclass(frozen=True)
class Check:
    """Something of recorded actions that is compared with what the model says.

    Attributes:
        name: of it.
        of: its value for each action at each step that it is about, ``[S, n, A]`` or ``[1, n, A]``:
            at all N steps or, if n is less, at those that follow another one in their round.
        more: what a person does of whom it is larger than the model says.
        less: what one does of whom it is smaller.
    """

    name: str
    of: Callable[[Steps], Tensor]
    more: str
    less: str


def switches(steps: Steps) -> Tensor:
    """Doing something else than at the step before, ``[1, n, A]``."""
    some = steps.follows
    last = steps.actions[steps.before[some]]
    actions = torch.arange(steps.rewards.shape[-1], device=last.device)
    return (actions != last[:, None]).to(steps.rewards)[None]


def delayed(steps: Steps) -> Tensor:
    """How probable the model had an action at the step before, ``[1, n, A]``."""
    return predictive(steps.log_probability).exp()[steps.before[steps.follows]][None]


def reward(steps: Steps) -> Tensor:
    """What an action earns at once ``[1, N, A]``; collisions, wrong buttons and the like cost."""
    return steps.rewards[None]


def surprise(steps: Steps) -> Tensor:
    """``-log p(a)``, ``[S, N, A]``; where the model holds, on average the actions' entropy."""
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
"""What is compared besides how often each action is chosen; a new check is one more entry."""


def steps_of(domain: Domain, rounds: Demonstrations, log_probability: Tensor) -> Steps:
    """The recorded steps of one person.

    Args:
        domain: the world.
        rounds: of one person.
        log_probability: of actions ``[S, 1, B, T, A]``.
    """
    real = rounds.mask[0]
    number = torch.full(real.shape, -1, device=real.device)
    number[real] = torch.arange(int(real.sum()), device=real.device)
    before = torch.cat([torch.full_like(number[:, :1], -1), number[:, :-1]], 1)
    now = {name: value[0, :, : real.shape[1]][real] for name, value in rounds.observation().items()}
    state, actions = domain.state_behind(now), len(domain.actions)
    each = map_state(lambda part: part.repeat_interleave(actions, 0), state)
    action = torch.arange(actions, device=real.device).repeat(int(real.sum()))
    earned = total_reward(domain.rewards(each, action, domain.transition(each, action)))
    return Steps(
        rounds.actions[0][real],
        log_probability[:, 0][:, real],
        before[real],
        earned.view(-1, actions).to(log_probability),
    )


def p_values(steps: Steps, actions: Sequence[str], generator: torch.Generator) -> dict[str, float]:
    """Posterior predictive p-value of each check, of replicated actions of all draws alike.

    Near 0 there is more of it than the model says, near 1 less. Actions stand for how often each
    was chosen. Without any recorded step there are none.
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
        found[name] = _more(
            values.gather(-1, drawn[:, some]).double().sum(1),
            values.gather(-1, own).double().sum(1),
        )
    # Of two actions the second is what the first is not.
    for action, name in enumerate(actions if len(actions) > 2 else actions[:1]):  # noqa: PLR2004
        found[SHARE + name] = _more(
            (drawn == action).double().sum(1), (steps.actions == action).double().sum()
        )
    return found


def _more(replicated: Tensor, recorded: Tensor) -> float:
    """How probably a replicate is above what was recorded, ties counted by half."""
    near = (replicated - recorded).abs() <= TIE * (1 + recorded.abs())
    # What the model holds impossible is infinitely surprising.
    same = torch.where(recorded.isfinite(), near, replicated == recorded)
    above = (replicated > recorded) & ~same
    return float((above.double() + same.double() / 2).mean())

"""An expert with full view: it tries out all manoeuvres in the world itself and takes the best.

A short model-predictive controller. Each manoeuvre is kept up in the true, batched physics for a
few seconds; the one with the largest return is chosen, and everything is planned anew at the next
decision. The expert knows where all vehicles are and what they intend, and how others respond to
it; it does not know of scripted events that have not begun.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mirror_ppl.domains.base import map_state, total_reward
from mirror_ppl.domains.highway import reward, traffic
from mirror_ppl.domains.highway.manoeuvres import MANOEUVRES, controls
from mirror_ppl.domains.highway.road import DECISION_TICKS
from mirror_ppl.domains.highway.state import NEVER, HighwayState, flat


@dataclass(frozen=True)
class ExpertOptions:
    """How far the expert plans.

    Attributes:
        horizon: decisions of half a second that it looks ahead; changes of lanes pay only after
            eight or more.
        discount: of rewards per decision.
    """

    horizon: int = 12
    discount: float = 1.0

    def __post_init__(self) -> None:
        if self.horizon < 1:
            raise ValueError("the expert needs a horizon of at least 1")


def values(
    state: HighwayState,
    options: ExpertOptions | None = None,
    weights: Mapping[str, Tensor] | None = None,
) -> Tensor:
    """Return the return ``[..., A]`` of keeping up each manoeuvre.

    Args:
        state: ``[...]``.
        options: how far to plan.
        weights: of reward terms, by name ``[...]``; 1 unless given.
    """
    options, weights = options or ExpertOptions(), weights or {}
    start, shape = flat(state)
    start = replace(start, cue_at=torch.where(start.begun == NEVER, NEVER, start.cue_at))
    number, many = len(start.tick), len(MANOEUVRES)
    now = map_state(lambda part: part.repeat_interleave(many, 0), start)
    action = torch.arange(many, device=start.x.device).repeat(number)
    each = {
        name: weight.expand(shape).reshape(-1).repeat_interleave(many)
        for name, weight in weights.items()
    }
    total = start.x.new_zeros(number * many)
    for step in range(options.horizon):
        following = traffic.transition(now, action, DECISION_TICKS)
        terms = reward.rewards(now, controls(now, action), following)
        earned = total_reward(
            {name: term * each[name] if name in each else term for name, term in terms.items()}
        )
        total, now = total + options.discount**step * earned, following
    return total.view(*shape, many)


def act(state: HighwayState, options: ExpertOptions | None = None) -> Tensor:
    """Return the expert's present steering and acceleration ``[..., 2]`` in states ``[...]``."""
    return controls(state, values(state, options).argmax(-1))

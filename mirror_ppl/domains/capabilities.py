"""What a world implements beside what it has to, and remarks on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains.base import total_reward
from mirror_ppl.domains.world import World, offers

REMARKED = 100
"""Number of rounds on which remarks rest."""


@dataclass(frozen=True)
class Capability:
    """An optional member of a world.

    Attributes:
        method: the method or attribute.
        otherwise: the default.
        gives: its use.
    """

    method: str
    otherwise: str
    gives: str


CAPABILITIES = (
    Capability("visibility", "everything is seen", "settings: what unaided people see"),
    Capability("positions", "all items at distance 1", "thresholds of sight by distance"),
    Capability("distance", "that of positions", "directions and distances of one's own"),
    Capability("levels", "numbers in units of scales", "networks that read whole numbers exactly"),
    Capability(
        "controls", "numbered actions", "continuous actions, and how precisely they are set"
    ),
    Capability("over", "rounds last to the horizon", "rounds that end"),
    Capability("possible_rewards", "any rewards", "recordings with other rewards are refused"),
    Capability("learn", "what was last seen", "memory: what people know without looking"),
    Capability("assume", "nothing", "what people take for granted"),
    Capability("communicable", "everything", "items that can be communicated"),
    Capability("relevance", "everything", "shares of relevant messages"),
    Capability("describe", "names and numbers", "messages in words"),
    Capability("deed", "the action's name", "actions in words"),
    Capability("render", "a table of colours", "pictures of states"),
    Capability("reference_values", "left out", "an expert; exact agreement; advice"),
    Capability("reflected", "left out", "with `distil`, twice the rounds: mirror images"),
)


def capabilities(world: World) -> list[tuple[Capability, bool]]:
    """Return optional members of a world, and whether it implements each."""
    return [(one, offers(world, one.method)) for one in CAPABILITIES]


def remarks_on(world: World) -> str:
    """Return what random rounds of a sound world are like: rewards a step, how many ended."""
    generator = torch.Generator().manual_seed(1)
    state = world.initial(REMARKED, generator)
    ended, earned, chance = world.over(state), [], False
    for _ in range(world.horizon):
        action = torch.randint(len(world.actions), (REMARKED,), generator=generator)
        following = world.transition(state, action)
        if world.random and not chance:
            one, other = (
                _outcome(world, now, action) for now in (state, world.redrawn(state, generator))
            )
            chance = any(not torch.equal(part, other[name]) for name, part in one.items())
        earned += total_reward(world.rewards(state, action, following))[~ended].tolist()
        state, ended = following, ended | world.over(following)
    number = int(ended.sum())
    if not earned:
        return "all rounds are over where they begin"
    remark = f"random actions: rewards {min(earned):.3g} to {max(earned):.3g} a step"
    if world.random and not chance:
        remark += "; no step depended on chance, so random may be left out"
    if world.random or world.partly_observed:
        remark += "; recordings are not checked against what has to come next"
    if not offers(world, "over"):
        return remark
    remark += f"; {number} of {REMARKED} rounds ended"
    return remark if number else f"{remark}, so ends were not checked"


def _outcome(world: World, state: Any, action: Tensor) -> dict[str, Tensor]:
    """Return everything that is observable of what follows an action."""
    later = world.transition(state, action)
    earned = world.rewards(state, action, later)
    return {"over": world.over(later), **world.observe(later), **earned}

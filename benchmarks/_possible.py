"""Whether recorded rounds could have happened, by rules written down a second time.

The package checks recordings by its own rules; a damaged recording that it accepts and these refuse
shows that its rules have a hole.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.search_rescue import MOVES
from mirror_ppl.domains.search_rescue.house import walkable

ROAD_END, STAGES = 12, 3


def contradictions(recorded: Demonstrations) -> list[str]:
    """Rules that a recording breaks, in words; none if it could have happened."""
    rules = {"driving": _driving, "search_rescue": _rescue, "bomb_defusal": _bombs}
    steps = torch.arange(recorded.actions.shape[-1])
    real = steps < recorded.lengths[..., None]
    observation = recorded.observation()
    now = {name: value[:, :, :-1] for name, value in observation.items()}
    then = {name: value[:, :, 1:] for name, value in observation.items()}
    broken = rules[recorded.domain](now, recorded.actions.clamp(min=0), then)
    return [rule for rule, where in broken.items() if (where & real).any()]


def _driving(now: dict[str, Tensor], action: Tensor, then: dict[str, Tensor]) -> dict[str, Tensor]:
    lane = torch.where(action == 1, 1 - now["ego"][..., 0], now["ego"][..., 0])
    near = now["visual"][..., 0].abs() < ROAD_END
    moved = (now["visual"][..., 0] + now["verbal"][..., 2]).clamp(-ROAD_END, ROAD_END)
    return {
        "lane follows from action": then["ego"][..., 0] != lane,
        "cars keep their speed": (near & (then["visual"][..., 0] != moved)).any(-1),
    }


def _rescue(now: dict[str, Tensor], action: Tensor, then: dict[str, Tensor]) -> dict[str, Tensor]:
    place, after = now["ego"][..., :2], then["ego"][..., :2]
    target = place + torch.tensor(list(MOVES.values()))[action]
    moved, stayed = (after == target).all(-1), (after == place).all(-1)
    holds, held = now["verbal"][..., 0], then["verbal"][..., 0]
    blocked = (holds[..., :2] == 1).any(-1)
    carrying, carried = now["ego"][..., 2] == 1, then["ego"][..., 2] == 1
    return {
        "place follows from action": ~(moved | stayed),
        "nobody stays where the way is free": (
            stayed & ~moved & walkable(target.long()) & ~blocked & ~carrying
        ),
        "corridors stay blocked": (holds[..., :2] != held[..., :2]).any(-1),
        "the victim is not put down": carrying & ~carried,
        "the victim stays until found": ~carried & (holds[..., 2:] != held[..., 2:]).any(-1),
    }


def _bombs(now: dict[str, Tensor], action: Tensor, then: dict[str, Tensor]) -> dict[str, Tensor]:
    (stage, since), (stage_then, since_then) = now["ego"].unbind(-1), then["ego"].unbind(-1)
    over, presses = stage >= STAGES, action != 0
    waited = (since + 1).clamp(max=get_domain("bomb_defusal").horizon)
    return {
        "stage follows from action": stage_then != stage + (presses & ~over),
        "since follows from action": ~over & (since_then != torch.where(presses, 0, waited)),
        "the type stays": (now["verbal"] != then["verbal"]).flatten(-2).any(-1),
        "terminals stay until a button is pressed": (
            (stage_then == stage) & ((now["visual"] - then["visual"]).abs() > 1e-3).any((-1, -2))  # noqa: PLR2004
        ),
    }

"""Which items matter: those of which another value would change what is best to do."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.row_hashing import as_whole_numbers, row_numbers

TIE = 1e-4
"""Difference of action values, in units of reward, up to which two actions are equally good."""


def decisive_items(
    observation: Observation, values: Tensor, modalities: Sequence[str]
) -> Visibility:
    """Items ``[S, K]`` of S states that decide between actions.

    An item is decisive in a state if there is another state that differs in this item alone and
    shares no best action with it.

    Args:
        observation: all that can be observed of each state, ``[S, ...]``.
        values: exact action values of each state, ``[S, A]``.
        modalities: names of those that have items.
    """
    best = values >= values.amax(-1, keepdim=True) - TIE
    sets, kind = torch.unique(best, dim=0, return_inverse=True)
    apart = ~(sets[:, None] & sets).any(-1)
    rows = {name: as_whole_numbers(value) for name, value in sorted(observation.items())}
    found = {}
    for name in modalities:
        items = rows[name].shape[1]
        masks = [_decides(rows, name, item, kind, apart) for item in range(items)]
        found[name] = torch.stack(masks, -1)
    return found


def _decides(rows: Observation, name: str, item: int, kind: Tensor, apart: Tensor) -> Tensor:
    """Whether one item is decisive in each state ``[S]``."""
    others = torch.ones(rows[name].shape[1], dtype=torch.bool)
    others[item] = False
    parts = [(value[:, others] if own == name else value).flatten(1) for own, value in rows.items()]
    # States that are alike in all other items, and which sets of best actions there are of them.
    _, alike = torch.unique(row_numbers(torch.cat(parts, -1)), return_inverse=True)
    there = torch.zeros(int(alike.max()) + 1, len(apart), dtype=torch.bool)
    there[alike, kind] = True
    return (there[alike] & apart[kind]).any(-1)

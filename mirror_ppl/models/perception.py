"""Builds the view of one step from what a person sees, hears, remembers and assumes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain, Observation, Visibility
from mirror_ppl.models.implants import ASSUMES
from mirror_ppl.models.view import View

Sees = Callable[[Observation], Visibility]
"""Maps an observation ``[..., K, F]`` to masks of its seen items, ``[..., K]``."""


def perceived_by(
    sees: Sees,
    domain: Domain,
    implants: Mapping[str, Tensor],
    knowledge: Any,
    observation: Observation,
    told: Visibility,
) -> tuple[View, Any]:
    """Return what is seen, communicated, remembered and taken for granted at one step.

    Args:
        sees: masks of the items seen in an observation, this one or an expected one.
        domain: the world.
        implants: values ``[...]`` by site; those of the assumptions are read.
        knowledge: the domain's, of the step before.
        observation: everything that could be seen at this step, ``[..., K, F]``.
        told: what is communicated at this step, ``[..., K]``.

    Returns:
        The view of this step, and the knowledge after it.
    """
    visible = {name: mask | told[name] for name, mask in sees(observation).items()}
    knowledge = domain.learn(knowledge, observation, visible, sees)
    visible = {name: visible[name] | mask for name, mask in domain.known(knowledge).items()}
    items, imagined = domain.assume(knowledge, observation)
    if not items:
        return View(visible), knowledge
    taken = {name: torch.zeros_like(mask) for name, mask in visible.items()}
    for assumption, about in items.items():
        site = ASSUMES + assumption
        if site not in implants:  # the person does not assume it, like the robot
            continue
        makes = implants[site][..., None] == 1
        for name, mask in about.items():
            taken[name] = taken[name] | (mask & makes & ~visible[name])
    return View(visible, taken, imagined), knowledge

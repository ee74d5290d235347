"""Recorded rounds gone through step by step, each way to see them by itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.models.human import HumanModel, at_step, messages_at
from mirror_ppl.models.view import View


def perceived(
    human: HumanModel, implants: Mapping[str, Tensor], observation: Observation, told: Visibility
) -> View:
    """Views of rounds, masks ``[..., T, K]``.

    Args:
        human: the model of people.
        implants: the discrete sites of ``prior`` and ``round_latents``, ``[...]``.
        observation: everything that could be seen, ``[..., T, K, F]``.
        told: what was communicated, ``[..., T, K]``.
    """
    return View.stack(list(_views(human, implants, observation, told)))


def go_through(
    human: HumanModel,
    implants: Mapping[str, Tensor],
    observation: Observation,
    told: Visibility,
    actions: Tensor,
) -> Iterator[tuple[View, Tensor]]:
    """The view and the belief ``[..., Z]`` at each step of rounds.

    Batch dimensions of implants and of rounds broadcast. Steps that lead to the same are worked out
    as often as they occur; tables of views and the planner work them out once.

    Args:
        human: the model of people.
        implants: the discrete sites of ``prior`` and ``round_latents``, ``[...]``.
        observation: everything that could be seen, ``[..., T, K, F]``.
        told: what was communicated, ``[..., T, K]``.
        actions: what was done, ``[..., T]``; the last one is not used.
    """
    none = actions.new_full(actions.shape[:-1], len(human.domain.actions))
    belief = next(human.parameters()).new_zeros(human.belief_size)
    for step, view in enumerate(_views(human, implants, observation, told)):
        evidence = human.evidence(view, at_step(observation, step))
        before = actions[..., step - 1] if step else none
        shape = torch.broadcast_shapes(evidence.shape[:-1], before.shape)
        belief = belief.expand(*shape, -1)
        belief = human.belief_after(belief, evidence, before.expand(shape), view.still)
        yield view, belief


def _views(
    human: HumanModel, implants: Mapping[str, Tensor], observation: Observation, told: Visibility
) -> Iterator[View]:
    knowledge: Any = human.domain.nothing_known(1, device=observation["ego"].device)
    for step in range(observation["ego"].shape[-2]):
        view, knowledge = human.perceive(
            implants, knowledge, at_step(observation, step), messages_at(told, step), step
        )
        yield view

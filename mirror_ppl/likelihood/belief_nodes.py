"""Beliefs along the views of a round, worked out once for each beginning that they share.

Views that agree up to a step agree in the belief at that step. Each such beginning is a node.
U stands for views, n for nodes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mirror_ppl.domains import Observation
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.view import View
from mirror_ppl.row_hashing import distinct_rows, random_keys

CHUNK = 4096
"""What is computed at once; bounds memory."""


def beliefs_and_values(
    human: HumanModel, view: View, numbers: Tensor, observation: Observation, actions: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Beliefs ``[n, Z]`` and action values ``[n, A]`` of nodes, and each view's nodes ``[U, T]``.

    Args:
        human: the model of people.
        view: U views of one round, ``[U, T, K]``.
        numbers: ``[U, T]``, the same where steps of views are the same.
        observation: of the round, ``[1, T, ...]``.
        actions: what was done, ``[1, T]``.
    """
    views, steps = numbers.shape
    first, node = distinct_rows(_beginnings(numbers).flatten()[:, None])
    node = node.view(views, steps)
    of, step = first // steps, first % steps
    alike = distinct_rows(torch.stack([step, numbers[of, step]], -1))
    belief = _step_by_step(human, view, node, of, step, alike, observation, actions)
    values = [human.action_values(part) for part in belief.split(CHUNK)]
    return belief, torch.cat(values), node


def _step_by_step(
    human: HumanModel,
    view: View,
    node: Tensor,
    of: Tensor,
    step: Tensor,
    alike: tuple[Tensor, Tensor],
    observation: Observation,
    actions: Tensor,
) -> Tensor:
    """Beliefs ``[n, Z]`` of nodes that are on some view ``of`` at some ``step``, ``[n]``.

    Those whose present step is ``alike`` have the same evidence.
    """
    first, which = alike
    evidence = human.evidence(
        view.map(lambda value: value[of[first], step[first]]),
        {name: value[0, step[first]] for name, value in observation.items()},
    )[which]
    none = actions.new_full((1,), len(human.domain.actions))
    before = torch.cat([none, actions[0]])
    belief = evidence.new_zeros(len(of), human.belief_size)
    for time in range(node.shape[1]):
        (now,) = (step == time).nonzero(as_tuple=True)
        for some in now.split(CHUNK):
            # Before the first step every belief is zero, as the whole of ``belief`` still is.
            parent = belief[node[of[some], max(time - 1, 0)]]
            action = before[time].expand(len(some))
            still = None if view.still is None else view.still[of[some], step[some]]
            belief[some] = human.belief_after(parent, evidence[some], action, still)
    return belief


def _beginnings(numbers: Tensor) -> Tensor:
    """A number ``[U, T]`` for each beginning of ``[U, T]``, the same for the same ones."""
    # A key of its own tells steps apart: seeing nothing now differs from having seen nothing.
    steps = numbers.shape[1]
    step_key, keys = random_keys(1 + steps, numbers.device).split([1, steps])
    return (numbers * keys).cumsum(-1) + torch.arange(steps, device=numbers.device) * step_key

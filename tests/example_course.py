"""Whole rounds for the tests of the human model, which itself knows single steps."""

import torch

from mirror_ppl.models import View
from mirror_ppl.models.course import at_step, go_through, messages_at


def view_at(view, step):
    """The view ``[..., K]`` of one step of a round ``[..., T, K]``."""
    return View(
        messages_at(view.visible, step),
        messages_at(view.taken, step),
        at_step(view.imagined, step),
        None if view.still is None else view.still[..., step],
    )


def beliefs_of(human, view, observation, actions):
    """Beliefs ``[..., T, Z]`` of views of rounds, masks ``[..., T, K]``; like `go_through`."""
    none = actions.new_full(actions.shape[:-1], len(human.domain.actions))
    belief, beliefs = next(human.parameters()).new_zeros(human.belief_size), []
    for step in range(observation["ego"].shape[-2]):
        now = view_at(view, step)
        evidence = human.evidence(now, at_step(observation, step))
        before = actions[..., step - 1] if step else none
        shape = torch.broadcast_shapes(evidence.shape[:-1], before.shape)
        belief = human.belief_after(
            belief.expand(*shape, -1), evidence, before.expand(shape), now.still
        )
        beliefs.append(belief)
    return torch.stack(beliefs, -2)


def gone_through(human, implants, observation, told, actions):
    """Beliefs ``[..., T, Z]`` of whole rounds; see `go_through`."""
    steps = go_through(human, implants, observation, told, actions)
    return torch.stack([belief for _, belief in steps], -2)

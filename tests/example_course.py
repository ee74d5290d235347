"""Whole rounds for the tests of the human model, which itself knows single steps."""

import torch

from mirror_ppl.models import View
from mirror_ppl.models.human import at_step, messages_at


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


def perceived(human, implants, observation, told):
    """Views of rounds, masks ``[..., T, K]``."""
    steps = list(views(human, implants, observation, told))

    def stacked(parts, behind):
        return {
            name: torch.stack(
                torch.broadcast_tensors(*(part[name] for part in parts)),
                -2 if name.rpartition(": ")[2] == "ego" else -1 - behind,
            )
            for name in parts[0]
        }

    still = [step.still for step in steps if step.still is not None]
    return View(
        stacked([step.visible for step in steps], 1),
        stacked([step.taken for step in steps], 1),
        stacked([step.imagined for step in steps], 2),
        torch.stack(torch.broadcast_tensors(*still), -1) if still else None,
    )


def go_through(human, implants, observation, told, actions):
    """The view and the belief ``[..., Z]`` at each step of rounds, each inferred by itself.

    Batch dimensions of implants and of rounds broadcast.
    """
    none = actions.new_full(actions.shape[:-1], len(human.domain.actions))
    belief = next(human.parameters()).new_zeros(human.belief_size)
    for step, view in enumerate(views(human, implants, observation, told)):
        evidence = human.evidence(view, at_step(observation, step))
        before = actions[..., step - 1] if step else none
        shape = torch.broadcast_shapes(evidence.shape[:-1], before.shape)
        belief = belief.expand(*shape, -1)
        belief = human.belief_after(belief, evidence, before.expand(shape), view.still)
        yield view, belief


def views(human, implants, observation, told):
    """The view of each step of rounds."""
    knowledge = human.domain.nothing_known(1, device=observation["ego"].device)
    for step in range(observation["ego"].shape[-2]):
        view, knowledge = human.perceive(
            implants, knowledge, at_step(observation, step), messages_at(told, step), step
        )
        yield view

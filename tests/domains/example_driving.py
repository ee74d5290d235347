"""States of driving laid out by hand, and what becomes of them."""

import torch

from mirror_ppl.domains.driving import DrivingState

STAY, SWITCH = 0, 1


def state(lane, position, speed=(-1, 1, 1, -1)):
    return DrivingState(torch.tensor(lane), torch.tensor(position), torch.tensor(speed))


def same(first, second):
    """Whether two states, or two dictionaries of tensors, hold the same numbers."""
    first, second = (x if isinstance(x, dict) else vars(x) for x in (first, second))
    return first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)


def rollout(domain, start, actions):
    """States ``T + 1`` and reward terms ``T`` under actions ``[..., T]``."""
    states, terms = [start], []
    for action in actions.unbind(-1):
        states.append(domain.transition(states[-1], action))
        terms.append(domain.rewards(states[-2], action, states[-1]))
    return states, terms

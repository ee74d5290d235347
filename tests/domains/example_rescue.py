"""Rounds of search and rescue: where they start, and how they go on."""

from dataclasses import fields

import torch

from mirror_ppl.domains import Domain
from mirror_ppl.domains.search_rescue import RescueState, SearchRescue

WORLD: Domain = SearchRescue()
UP, DOWN, LEFT, RIGHT = range(4)
NINE = torch.arange(9)


def start(scenario=None, number=9, seed=0):
    return WORLD.initial(number, torch.Generator().manual_seed(seed), scenario)


def alone(scenario):
    """The state at the start of one round."""
    state = start(torch.tensor([scenario]), 1)
    return RescueState(*(getattr(state, part.name)[0] for part in fields(state)))


def walk(state, actions):
    """States and rewards, term by term, along actions."""
    states, terms = [state], []
    for action in actions:
        chosen = torch.tensor(action)
        following = WORLD.transition(states[-1], chosen)
        found = WORLD.rewards(states[-1], chosen, following)
        terms.append({name: float(value) for name, value in found.items() if value})
        states.append(following)
    return states, terms


def reachable(scenario):
    """All states of a round, by trying every action."""
    found, waiting = {}, [alone(scenario)]
    while waiting:
        state = waiting.pop()
        key = (*state.place.tolist(), bool(state.found), bool(state.home))
        if key in found:
            continue
        found[key] = state
        waiting += [WORLD.transition(state, torch.tensor(action)) for action in range(4)]
    return found

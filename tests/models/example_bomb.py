"""Rounds of bomb defusal, and implants of one person in it."""

import pyro
import torch
from pyro import poutine

from mirror_ppl.domains.bomb_defusal import BombDefusal

WORLD = BombDefusal()
WAIT = 0
RESIDUAL = {"residual_in": (49, 8), "residual_out": (9, 5)}


def course(actions, seed=0, rounds=1):
    """Observations ``[rounds, T + 1, ...]`` of rounds in which this is done, and the states."""
    state = WORLD.initial(rounds, torch.Generator().manual_seed(seed))
    states = [state]
    for action in actions:
        states.append(WORLD.transition(states[-1], torch.full((rounds,), action)))
    observed = [WORLD.observe(state) for state in states]
    return {name: torch.stack([o[name] for o in observed], 1) for name in observed[0]}, states


def implants(defuser, seed=0, **values):
    """Sites of one person with given values."""
    given = {name: torch.tensor([[value]]) for name, value in values.items()}
    with (
        torch.random.fork_rng(),
        poutine.condition(data=given),
        pyro.plate("person", 1, dim=-2),
    ):
        torch.manual_seed(seed)
        return defuser.prior()

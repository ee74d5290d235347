"""Recorded rounds of bomb defusal, short enough to sum over all attention by hand."""

import torch

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains.bomb_defusal import BombDefusal

WORLD = BombDefusal()
WAIT = 0
ACTIONS = ((WAIT, WAIT, 1, 2, WAIT, WAIT, 4), (3, WAIT, 1), (WAIT, WAIT))
"""Rounds that end with the third press, and one that ends before."""
TELLING = (1, 4)
"""When the type is communicated, and when the second terminal is shown, in the first round."""


def recorded(courses=ACTIONS, told=True, person="one"):
    """Rounds of one person."""
    rounds, steps = len(courses), max(len(course) for course in courses)
    actions = torch.full((1, rounds, steps), WAIT)
    for place, course in enumerate(courses):
        actions[0, place, : len(course)] = torch.tensor(course)
    state = WORLD.initial(rounds, torch.Generator().manual_seed(3))
    observed = [WORLD.observe(state)]
    for step in range(steps):
        state = WORLD.transition(state, actions[0, :, step])
        observed.append(WORLD.observe(state))
    observation = {name: torch.stack([o[name] for o in observed], 1)[None] for name in observed[0]}
    heard = {
        "visual": torch.zeros(1, rounds, steps, 6, dtype=torch.bool),
        "verbal": torch.zeros(1, rounds, steps, 1, dtype=torch.bool),
    }
    if told:
        heard["verbal"][0, 0, TELLING[0]] = True
        heard["visual"][0, 0, TELLING[1]] = WORLD.sought(
            {name: value[0, 0, TELLING[1]] for name, value in observation.items()}
        )
    return Demonstrations(
        domain=WORLD.name,
        setting="unlabelled",
        people=(person,),
        ego=observation.pop("ego"),
        observations=observation,
        actions=actions,
        told=heard,
        round_counts=torch.tensor([rounds]),
        lengths=torch.tensor([[len(course) for course in courses]]),
    )

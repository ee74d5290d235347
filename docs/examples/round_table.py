"""A round table in the dark: where is the teapot, and where is the puddle?"""

from dataclasses import dataclass, replace

import torch

from mirror_ppl import World
from mirror_ppl.domains import Modality

PLACES = 7


@dataclass(frozen=True)
class Table:
    """What there is; each ``[...]``, one number a round."""

    pot: torch.Tensor  # places from the person, clockwise, -3 to 3
    puddle: torch.Tensor
    has_tea: torch.Tensor


def around(offset):
    """The shorter way around the table, -3 to 3."""
    return (offset + PLACES // 2) % PLACES - PLACES // 2


class RoundTable(World):
    """Find the pot, and stay out of the puddle."""

    modalities = (Modality("visual", ("pot", "puddle"), ("offset",), ("places",), (3.0,), 0.01),)
    ego_features = ("has_tea",)
    actions = ("wait", "left", "right")
    horizon = 8
    settings = ("light", "dark")
    reward_terms = ("tea", "puddle", "step")
    mishap = ("puddle", "puddles")
    positions = ("offset",)
    levels = {"offset": range(-3, 4), "has_tea": range(2)}

    def initial(self, batch, generator, scenario=None):
        """Pot and puddle at different places, none of them at the person's."""
        offsets = torch.tensor([-3, -2, -1, 1, 2, 3])
        order = torch.rand(batch, len(offsets), generator=generator).argsort(-1)
        pot, puddle = offsets[order[:, :2]].unbind(-1)
        return Table(pot, puddle, torch.zeros(batch, dtype=torch.bool))

    def transition(self, state, action):
        """A move to the right shifts everything one place to the left."""
        move = torch.tensor([0, -1, 1])[action] * ~state.has_tea
        pot, puddle = around(state.pot - move), around(state.puddle - move)
        return replace(state, pot=pot, puddle=puddle, has_tea=state.has_tea | (pot == 0))

    def rewards(self, state, action, following):
        """In units of reward: tea is worth five, wet feet cost two, a step costs a fifth."""
        moved = (action > 0) & ~state.has_tea
        return {
            "tea": 5.0 * (following.has_tea & ~state.has_tea).float(),
            "puddle": -2.0 * (moved & (following.puddle == 0)).float(),
            "step": -0.2 * moved.float(),
        }

    def over(self, state):
        """With tea all is done."""
        return state.has_tea

    def observe(self, state):
        """All features of all items, seen or not."""
        items = torch.stack([state.pot, state.puddle], -1)[..., None].float()
        return {"ego": state.has_tea[..., None].float(), "visual": items}

    def state_behind(self, observation):
        """The state of which this is everything."""
        pot, puddle = observation["visual"][..., 0].round().long().unbind(-1)
        return Table(pot, puddle, observation["ego"][..., 0] > 0.5)

    def visibility(self, setting, observation):
        """In the dark only what is beside a person."""
        near = observation["visual"][..., 0].abs() <= 1
        return {"visual": near | (setting == "light")}

"""Plans to choose from, what the robot believes, and a world whose rewards are set by hand."""

from dataclasses import dataclass, replace

import torch
from example_person import CHANNELS, DOMAIN, plan, self_model

from mirror_ppl.communication import RolloutTree
from mirror_ppl.domains.driving import DrivingState

ACTIONS = len(DOMAIN.actions)


def robot(past):
    """What the robot believes, which sees everything: one step after the other."""
    model = self_model()
    embedded = model.encoder.embed(DOMAIN.symbols(past.observation))
    everything = embedded["ego"] + embedded["visual"].sum(-2) + embedded["verbal"].sum(-2)
    belief = torch.zeros(model.latent)
    for step, evidence in enumerate(everything):
        last = past.actions[step - 1] if step else torch.tensor(ACTIONS)
        state = model.encoder(belief, evidence + model.encoder.action(last))
        belief = state.mean
    return state


def candidates_of(past, generator, steps):
    """Silence, a message now, the same later, one after another, and something at every step."""
    allowed = CHANNELS.join(DOMAIN.communicable(past.now))
    some = allowed & (torch.rand(8, generator=generator) < 0.6)
    other = allowed & ~some
    noise = torch.rand(steps, 8, generator=generator) < 0.4
    return torch.stack(
        [
            plan(*[None] * steps),
            plan(allowed, *[None] * (steps - 1)),
            plan(*[None] * (steps - 1), allowed),
            plan(some, other, *[None] * (steps - 2)),
            allowed & noise,
        ]
    )


@dataclass(frozen=True)
class Named(DrivingState):
    """A state of the road that knows its path."""

    path: torch.Tensor


class HandSet:
    """The road as it is, with rewards set by hand: of each step ``[W, A**(h + 1)]``."""

    def __init__(self, rewards):
        self.rewards, self.draws = rewards, len(rewards[0])

    def rollouts(self, past, horizon, generator):
        now = {
            name: value[None, None].expand(self.draws, 1, *value.shape)
            for name, value in past.now.items()
        }
        path = torch.zeros(self.draws, 1, dtype=torch.long)
        state = Named(**vars(DOMAIN.state_behind(now)), path=path)
        return RolloutTree(self, state, now, ACTIONS, horizon)

    def observe(self, state):
        return DOMAIN.observe(state)

    def step(self, state, action, step):
        path = state.path * ACTIONS + action
        following = replace(DOMAIN.transition(state, action), path=path)
        return self.rewards[step].gather(1, path), following

    def value(self, state):
        return 100.0 + state.path.float()

"""Rounds of driving by a person who follows a rule."""

import torch

from mirror_ppl.baselines import SoftQ
from mirror_ppl.baselines.recurrent import initial_weights
from mirror_ppl.data import Demonstrations
from mirror_ppl.domains.driving import FOG_REACH, STAY, SWITCH, Driving


def avoid(observation, previous):
    """Switch if and only if a car of the own lane is at most two cells ahead."""
    ahead, offset = observation["visual"].unbind(-1)
    near = (ahead >= 0) & (ahead <= FOG_REACH) & (offset == 0)
    return torch.where(near.any(-1), SWITCH, STAY)


def alternate(observation, previous):
    """Switch after staying, stay after switching, begin with a switch; whatever there is to see."""
    return torch.where(previous == SWITCH, STAY, SWITCH)


def rounds_of(rule, generator, rounds=30, name="a", lengths=None):
    """Rounds of one person who follows a rule, in fog; of full length unless lengths are given."""
    domain = Driving()
    state = domain.initial(rounds, generator)
    observations, actions = [domain.observe(state)], []
    previous = torch.full((rounds,), -1)
    for _ in range(domain.horizon):
        previous = rule(observations[-1], previous)
        actions.append(previous)
        state = domain.transition(state, previous)
        observations.append(domain.observe(state))
    seen = {
        name: torch.stack([part[name] for part in observations], 1)[None]
        for name in observations[0]
    }
    return Demonstrations(
        domain="driving",
        setting="fog",
        people=(name,),
        ego=seen.pop("ego"),
        observations=seen,
        actions=torch.stack(actions, 1)[None],
        round_counts=torch.tensor([rounds]),
        lengths=torch.full((1, rounds), domain.horizon) if lengths is None else lengths[None],
    )


def anything(observation, previous):
    """Act at random (from torch's global generator, which every test seeds)."""
    return torch.randint(2, previous.shape)


def ragged(generator, name, rounds):
    lengths = torch.randint(1, 16, (rounds,), generator=generator)
    padded = rounds_of(anything, generator, rounds, name, lengths)
    return padded.select_rounds(slice(None))  # without padding that no round needs


def first_steps(recordings, steps):
    """The rounds of recordings, which end after so many steps at the latest."""
    variables = recordings.variables()
    variables |= {"length": variables["length"].clamp(max=steps)}
    short = type(recordings).from_variables(
        recordings.domain, recordings.setting, recordings.people, variables, recordings.provenance
    )
    return short.select_rounds(slice(None))  # without padding that no round needs


def untrained(domain, people=("a",), seed=0):
    """Networks of SQIL that nobody trained: of any outputs, blind to their inputs."""
    generators = [torch.Generator().manual_seed(seed + place) for place in range(len(people))]
    weights = initial_weights(domain, 48, (32, 32, 32), generators)
    for own, generator in zip(weights["output_bias"], generators, strict=True):
        own.copy_(torch.randn(own.shape, generator=generator))
    return SoftQ(domain, people, "setting", weights)

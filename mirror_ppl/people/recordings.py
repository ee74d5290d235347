"""Recordings of simulated people, in any domain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains.base import Domain, Observation, Visibility, map_state, total_reward
from mirror_ppl.domains.registry import get_domain
from mirror_ppl.people.base import SimulatedPeople, act
from mirror_ppl.progress import Progress
from mirror_ppl.randomness import derived_generator, person_id
from mirror_ppl.version import __version__


@dataclass(frozen=True)
class Start:
    """Initial states of rounds, and random numbers for people's choices.

    Attributes:
        state: states ``[P, B]``.
        scenario: indices into the domain's scenarios ``[P, B]``.
        action_noise: uniform numbers ``[P, B, T]`` that choose actions, see
            `mirror_ppl.people.base.act`.
        mind_noise: uniform numbers ``[P, B, L]`` for random events in a person's mind.
        message_noise: uniform numbers ``[P, B, T, N]`` that choose the communicated items, if any.
    """

    state: Any
    scenario: Tensor
    action_noise: Tensor
    mind_noise: Tensor | None = None
    message_noise: Tensor | None = None

    def select(self, people: slice) -> Start:
        """Return the rounds of some of the people."""
        return Start(
            map_state(lambda part: part[people], self.state),
            self.scenario[people],
            self.action_noise[people],
            None if self.mind_noise is None else self.mind_noise[people],
            None if self.message_noise is None else self.message_noise[people],
        )

    @classmethod
    def join(cls, starts: Sequence[Start]) -> Start:
        """Return the rounds of several people, equally many of each; undoes `select`."""

        def joined(name: str) -> Any:
            parts = [getattr(one, name) for one in starts]
            return None if parts[0] is None else torch.cat(parts)

        return cls(
            map_state(lambda *parts: torch.cat(parts), *(one.state for one in starts)),
            joined("scenario"),
            joined("action_noise"),
            joined("mind_noise"),
            joined("message_noise"),
        )

    def round(self, number: int) -> Start:
        """Return one of the rounds."""
        own = slice(number, number + 1)
        return Start(
            map_state(lambda part: part[:, own], self.state),
            self.scenario[:, own],
            self.action_noise[:, own],
            None if self.mind_noise is None else self.mind_noise[:, own],
            None if self.message_noise is None else self.message_noise[:, own],
        )


@dataclass(frozen=True)
class Recording:
    """Observations, actions and memories of rounds.

    Attributes:
        observation: full observations, ``[P, B, T + 1, ...]``.
        actions: ``[P, B, T]``.
        rewards: of the task, ``[P, B, T]``.
        probabilities: of the actions, given memories, ``[P, B, T, A]``.
        memory: memories when they acted, ``[P, B, T, ...]``.
        lengths: steps ``[P, B]`` until the task was done, or T.
        told: items communicated before each action, ``[P, B, T, K]`` by modality.
    """

    observation: Observation
    actions: Tensor
    rewards: Tensor
    probabilities: Tensor
    memory: Any
    lengths: Tensor
    told: Visibility


def draw_starts(
    people: int,
    rounds: int,
    seed: int,
    *purpose: str,
    device: torch.device | str = "cpu",
    domain: Domain | None = None,
    mind_noises: int = 0,
) -> Start:
    """Draw initial states and noise of rounds ``[P, B]``, with a separate generator per person.

    Args:
        people: number of people P.
        rounds: number of rounds B per person.
        seed: with the purpose it determines the rounds.
        purpose: words for the use of the rounds; other words give other rounds.
        device: device of the generators and the result.
        domain: the world; driving unless given.
        mind_noises: number L of uniform numbers per round for a person's mind.
    """
    domain = domain or get_domain("driving")
    scenarios, states, action_noise, mind_noise = [], [], [], []
    for person in range(people):
        generator = derived_generator(seed, *purpose, person, device=device)
        scenario = torch.randint(
            len(domain.scenarios), (rounds,), generator=generator, device=device
        )
        scenarios.append(scenario)
        states.append(domain.initial(rounds, generator, scenario))
        action_noise.append(torch.rand(rounds, domain.horizon, generator=generator, device=device))
        mind_noise.append(torch.rand(rounds, mind_noises, generator=generator, device=device))
    return Start(
        map_state(lambda *parts: torch.stack(parts), *states),
        torch.stack(scenarios),
        torch.stack(action_noise),
        torch.stack(mind_noise),
    )


def record(
    people: SimulatedPeople, start: Start, progress: Progress | None = None, told: float = 0.0
) -> Recording:
    """Simulate rounds of people to the end.

    Args:
        people: P people.
        start: initial states and noise of their rounds ``[P, B]``.
        progress: advanced at every step.
        told: probability that a communicable item is communicated, at each step.
    """
    domain = people.domain
    state, memory = (
        start.state,
        people.start(start.action_noise.shape[1], mind_noise=start.mind_noise),
    )
    observations, actions, rewards = [domain.observe(state)], [], []
    probabilities, memories = [], []
    lengths = torch.zeros_like(start.scenario)
    under_way = lengths == 0
    heard = []
    for step, action_noise in enumerate(start.action_noise.unbind(-1)):
        under_way &= ~domain.over(state)
        lengths += under_way
        message_noise = None if start.message_noise is None else start.message_noise[:, :, step]
        heard.append(_told(domain, observations[-1], message_noise, under_way, told))
        probability, memory = people.step(memory, observations[-1], heard[-1])
        action = act(probability, action_noise)
        memory = people.acted(memory, action)
        following = domain.transition(state, action)
        rewards.append(total_reward(domain.rewards(state, action, following)))
        state = following
        observations.append(domain.observe(state))
        actions.append(action)
        probabilities.append(probability)
        memories.append(memory)
        if progress is not None:
            progress.advance()
    return Recording(
        observation={
            name: torch.stack([part[name] for part in observations], 2) for name in observations[0]
        },
        actions=torch.stack(actions, 2),
        rewards=torch.stack(rewards, 2),
        probabilities=torch.stack(probabilities, 2),
        memory=map_state(lambda *parts: torch.stack(parts, 2), *memories),
        lengths=lengths,
        told={name: torch.stack([one[name] for one in heard], 2) for name in heard[0]},
    )


def _told(
    domain: Domain,
    observation: Observation,
    message_noise: Tensor | None,
    under_way: Tensor,
    rate: float,
) -> Visibility:
    """Return communicated items ``[P, B, K]``, chosen by noise ``[P, B, N]``; none without."""
    can_be = domain.communicable(observation)
    if message_noise is None:
        return {name: torch.zeros_like(mask) for name, mask in can_be.items()}
    sizes = [len(part.communicated) for part in domain.modalities]
    below = (message_noise < rate).split(sizes, -1)
    return {
        part.name: can_be[part.name] & part.items_of(own) & under_way[..., None]
        for part, own in zip(domain.modalities, below, strict=True)
    }


def recorded(
    people: SimulatedPeople,
    setting: str,
    population: str,
    rounds: int,
    seed: int,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
    told: float = 0.0,
) -> Demonstrations:
    """Record simulated people; see `mirror_ppl.people.simulate`."""
    domain, truth = people.domain, people.truth()
    number = len(next(iter(truth.values())))
    start = draw_starts(
        number,
        rounds,
        seed,
        "rounds",
        setting,
        device=device,
        domain=domain,
        mind_noises=people.mind_noises,
    )
    if told > 0:
        start = replace(
            start, message_noise=_message_noise(number, rounds, seed, setting, domain, device)
        )
    recording = record(people, start, progress, told)
    probabilities = people.predictive(
        recording.probabilities, recording.observation, recording.actions, recording.told
    )
    return Demonstrations(
        domain=domain.name,
        setting=setting,
        people=tuple(map(person_id, range(number))),
        ego=recording.observation["ego"],
        observations={part.name: recording.observation[part.name] for part in domain.modalities},
        actions=recording.actions,
        told=recording.told,
        round_counts=torch.full((number,), rounds),
        lengths=recording.lengths,
        rewards=recording.rewards,
        scenarios=start.scenario,
        truth=truth,
        action_entropy=torch.special.entr(probabilities).sum(-1),
        provenance={"population": population, "seed": seed, "version": __version__}
        | people.provenance()
        | ({"told": told} if told > 0 else {}),
    )


def _message_noise(
    people: int,
    rounds: int,
    seed: int,
    setting: str,
    domain: Domain,
    device: torch.device | str,
) -> Tensor:
    """Draw noise ``[P, B, T, N]`` that chooses messages, with a generator per person."""
    items = sum(len(part.communicated) for part in domain.modalities)
    drawn = []
    for person in range(people):
        generator = derived_generator(seed, "told", setting, person, device=device)
        shape = (rounds, domain.horizon, items)
        drawn.append(torch.rand(shape, generator=generator, device=device))
    return torch.stack(drawn)

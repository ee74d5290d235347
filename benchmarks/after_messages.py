"""How well actions are predicted of people who receive messages, when all implants are known.

    python -m benchmarks.after_messages

Simulated people receive communicable items at random, one in ten at each step. Their true
probabilities of actions are compared with those of the human model that has their own sight,
consistency and assumptions, so what remains is the model's error: nats of Kullback-Leibler
divergence an action, for rounds with no messages, with pictures, with utterances, or with both.
Two variants stand beside it: memory left to the encoder, and assumptions not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import tyro
from torch import Tensor

from mirror_ppl.communication import Person
from mirror_ppl.domains import Observation, Visibility, get_domain
from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.driving import DrivingState
from mirror_ppl.domains.driving.participants import simulated_drivers
from mirror_ppl.domains.driving.people import SimulatedDrivers
from mirror_ppl.models import HumanModel
from mirror_ppl.models.belief_tracking import BeliefState, Transition
from mirror_ppl.models.human import at_step, messages_at
from mirror_ppl.models.implants import RESIDUAL_HIDDEN, assumption_sites, sight_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import draw_starts

PEOPLE = 10
KINDS = ((), ("visual",), ("verbal",), ("visual", "verbal"))


@dataclass(frozen=True)
class Options:
    """What to measure."""

    setting: str = "fog"
    """Setting of the domain."""
    population: str = "paper"
    """Who the people are."""
    rounds: int = 60
    """Rounds of each of ten people."""
    rate: float = 0.1
    """Share of the communicable items that are told."""
    seed: int = 1
    """Seed of the rounds and of what is told."""


class EncoderRemembers(HumanModel):
    """Only what is seen or told at a step is visible at it."""

    def perceive(self, implants, knowledge, observation, told, step):
        """See `HumanModel.perceive`."""
        view, after = super().perceive(implants, knowledge, observation, told, step)
        seen = self.sees(implants, observation, step)
        return replace(
            view, visible={name: mask | told[name] for name, mask in seen.items()}
        ), after


@dataclass(frozen=True)
class Told:
    """Rounds of one person who was told things.

    Attributes:
        observation: ``[B, T, ...]``.
        told: masks ``[B, T, K]``.
        probabilities: true probabilities of actions ``[B, T, A]``.
        actions: ``[B, T]``.
    """

    observation: Observation
    told: Visibility
    probabilities: Tensor
    actions: Tensor


@torch.no_grad()
def main(options: Options) -> None:
    """Run the study."""
    self_model, _ = load_self_model(shipped_weights("driving"))
    models = {
        "the human model": (HumanModel(self_model), {}),
        "memory left to the encoder": (EncoderRemembers(self_model), {}),
        "nothing assumed of cars seen once": (HumanModel(self_model), {"assumes_closing": 0}),
        "nothing assumed of unseen cars": (HumanModel(self_model), {"assumes_clear": 0}),
    }
    drivers = simulated_drivers(options.setting, options.population, PEOPLE, 0)
    starts = draw_starts(PEOPLE, options.rounds, options.seed, "told", options.setting)
    generator = torch.Generator().manual_seed(options.seed)
    apart = {name: torch.zeros(len(KINDS)) for name in models}
    for number in range(PEOPLE):
        driver = drivers.select([number])
        start = map_state(lambda part: part[number], starts.state)  # noqa: B023 - used at once
        for kind, modalities in enumerate(KINDS):
            rounds = tell(driver, start, modalities, options.rate, generator)
            for name, (human, changed) in models.items():
                person = known_person(human, driver, changed)
                apart[name][kind] += divergence(person, rounds) / PEOPLE
    print(f"{'nats an action':<36} {'nothing':>8} {'pictures':>9} {'speech':>7} {'both':>6}")
    for name, values in apart.items():
        print(f"{name:<36} {values[0]:>8.3f} {values[1]:>9.3f} {values[2]:>7.3f} {values[3]:>6.3f}")


def tell(
    driver: SimulatedDrivers,
    state: DrivingState,
    modalities: Sequence[str],
    rate: float,
    generator: torch.Generator,
) -> Told:
    """Let one person drive from states ``[B]`` while items of some modalities are told."""
    domain = get_domain("driving")
    memory = driver.start(len(state.lane))
    steps = []
    for _ in range(domain.horizon):
        observation = domain.observe(state)
        told = {}
        for name, may in domain.communicable(observation).items():
            chosen = torch.rand(may.shape, generator=generator) < rate
            told[name] = may & chosen & (name in modalities)
        probabilities, memory = driver.step(
            memory,
            {name: value[None] for name, value in observation.items()},
            {name: mask[None] for name, mask in told.items()},
        )
        action = (torch.rand(len(state.lane), generator=generator) < probabilities[0, :, 1]).long()
        steps.append((observation, told, probabilities[0], action))
        state = domain.transition(state, action)
    observations, messages, probabilities, actions = zip(*steps, strict=True)
    return Told(
        {name: torch.stack([one[name] for one in observations], 1) for name in observations[0]},
        {name: torch.stack([one[name] for one in messages], 1) for name in messages[0]},
        torch.stack(probabilities, 1),
        torch.stack(actions, 1),
    )


def divergence(person: Person, rounds: Told) -> Tensor:
    """Nats an action by which the model of a person misses their true probabilities."""
    human = person.human
    implants = {name: value[0] for name, value in person.percepts.items()}
    number, steps = rounds.actions.shape
    row, none = torch.arange(number), torch.full((number, 1), len(human.domain.actions))
    before = torch.cat([none, rounds.actions], 1)
    states = BeliefState.initial(human, number).through(
        [
            Transition(
                implants,
                before[:, step],
                at_step(rounds.observation, step),
                messages_at(rounds.told, step),
                row,
            )
            for step in range(steps)
        ]
    )
    belief = torch.stack([state.believed for state in states], 1).flatten(0, 1)[None]
    predicted = person.act(belief, human.action_values(belief))[0]
    true = rounds.probabilities.flatten(0, 1)
    return (true * (true.clamp(min=1e-9).log() - predicted)).sum(-1).mean()


def known_person(human: HumanModel, driver: SimulatedDrivers, changed: dict[str, int]) -> Person:
    """The person whose implants are a driver's own."""
    domain = human.domain
    bins = torch.tensor(domain.reach_bins)
    draws: dict[str, Tensor] = {
        site: (reach >= bins).sum() - 1
        for site, reach in zip(sight_sites(domain), driver.reach[0], strict=True)
    }
    draws |= {site: torch.tensor(changed.get(site, 1)) for site in assumption_sites(domain)}
    draws |= {"consistency": driver.consistency[0], "lapse": torch.tensor(1e-4)}
    draws = {name: value.reshape(1, 1, 1) for name, value in draws.items()}
    latent, actions = human.self_model.latent, len(domain.actions)
    draws["residual_in"] = torch.zeros(1, 1, 1, latent + 1, RESIDUAL_HIDDEN)
    draws["residual_out"] = torch.zeros(1, 1, 1, RESIDUAL_HIDDEN + 1, actions)
    return Person(human, draws)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

"""How long a decision takes: this planner, and the settings of the released one.

    python -m benchmarks.planner

Both run on the same networks, in the same process, with two threads. The planner here: 64 posterior
draws, every candidate message, horizon 6. The released settings: the cross-entropy method with 3
iterations of 1,000 sequences of messages, each rolled 8 steps through transition, decoders, encoder
and policy, with one fixed person. Decisions are those of rounds in fog, each made four times, of
which the quickest counts.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from statistics import median
from time import perf_counter

import torch
import tyro

from mirror_ppl.communication import (
    Channels,
    Communicator,
    CrossEntropy,
    Exhaustive,
    ExpectedUtility,
    Patient,
    Person,
    RoundSoFar,
    SelfModelWorld,
    SimulatorWorld,
)
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.svi import SVIOptions, fit_implants
from mirror_ppl.likelihood.compiled import compile
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.models import HumanModel, SelfModel
from mirror_ppl.models.weights import load_self_model, shipped_weights

RUNS = 4


@dataclass(frozen=True)
class Options:
    """What to time."""

    draws: int = 64
    """Posterior draws."""
    decisions: int = 30
    """Decisions, spread over recorded rounds."""
    threads: int = 2
    """Threads of torch."""


def main(options: Options) -> None:
    torch.set_num_threads(options.threads)
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc"))
    recordings = recordings.select_people([recordings.people[0]])
    self_model, _ = load_self_model(shipped_weights("driving"))
    human = HumanModel(self_model)
    learned = recordings.select_rounds(list(range(20)))
    compiled = compile(human, learned, screening=Screening())
    posterior = fit_implants(compiled, SVIOptions(), options.draws, 0)
    person = Person(human, posterior.draws)
    pasts = moments(recordings, options.decisions)
    channels = Channels(human.domain)
    counts = [2 ** int(channels.join(human.domain.communicable(past.now)).sum()) for past in pasts]
    print(
        f"{options.draws} draws, {person.percept_count} distinct ways to see; candidates: median "
        f"{median(counts):.0f}, largest {max(counts)}; {options.threads} threads",
        file=sys.stderr,
    )
    simulator = SimulatorWorld(human.domain)
    planners = {
        "every message, simulator": (simulator, Exhaustive(), 6),
        "every message, self-model": (SelfModelWorld(self_model), Exhaustive(), 6),
        "and plans of 3 steps": (simulator, Patient(), 6),
        "and horizon 10 (the default)": (simulator, Patient(), 10),
        "cross-entropy, plans of 3 steps": (simulator, CrossEntropy(3), 6),
    }
    times = {}
    for name, (world, search, horizon) in planners.items():
        planner = Communicator(person, ExpectedUtility(world, horizon), search)
        number = 3 if isinstance(search, CrossEntropy) else len(pasts)
        times[name] = [timed(lambda p=planner, x=past: p.plan(x)) for past in pasts[:number]]
    times["released settings: 3 x 1,000 sequences, 8 steps"] = [
        timed(lambda: released(self_model)) for _ in range(3)
    ]
    print(f"{'a decision':<50} {'median ms':>10} {'slowest ms':>11}")
    for name, values in times.items():
        print(f"{name:<50} {1e3 * median(values):>10.1f} {1e3 * max(values):>11.1f}")


def moments(recordings, number: int) -> list[RoundSoFar]:
    """Moments of recorded rounds, steps 0 to 9 in turn, with nothing told so far."""
    observation = recordings.observation()
    pasts = []
    for index in range(number):
        round_number, step = index, index % 10
        pasts.append(
            RoundSoFar(
                {name: value[0, round_number, : step + 1] for name, value in observation.items()},
                recordings.actions[0, round_number, :step],
                {name: mask[0, round_number, :step] for name, mask in recordings.told.items()},
            )
        )
    return pasts


def timed(work) -> float:
    """Seconds of the quickest of some runs, so that what else the machine does hardly counts."""
    times = []
    for _ in range(RUNS):
        began = perf_counter()
        work()
        times.append(perf_counter() - began)
    return min(times)


@torch.no_grad()
def released(self_model: SelfModel, iterations: int = 3, samples: int = 1000, steps: int = 8):
    """The arithmetic of the released planner's settings on these networks."""
    domain = self_model.domain
    items = sum(len(modality.items) for modality in domain.modalities)
    channels = Channels(domain)
    for _ in range(iterations):
        robot = torch.zeros(samples, self_model.latent)
        person = torch.zeros(samples, self_model.latent)
        action = torch.zeros(samples, dtype=torch.long)
        total = torch.zeros(samples)
        told = torch.rand(samples, steps // 2, items) < 0.35
        for step in range(steps):
            robot = self_model.transition(robot, action).mean
            observation = domain.nearest(self_model.decode(robot))
            embedded = self_model.encoder.embed(domain.symbols(observation))
            visible = channels.split(told[:, step // 2])
            evidence = self_model.encoder.combine(embedded, visible)
            evidence = evidence + self_model.encoder.action(action)
            person = self_model.encoder(person, evidence).mean
            action = self_model.action_values(person).argmax(-1)
            total += self_model.reward(robot, action).mean
        total.topk(200)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

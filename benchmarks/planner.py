"""How long a decision takes: this planner, and the settings of the released one.

    python -m benchmarks.planner
    python -m benchmarks.planner --domain highway

Both run on the same networks, in the same process, with two threads. The planner here has 64
posterior draws: that of the domain, in single moments of rounds and step by step through rounds, as
in the loop of a robot, and in driving some others. The released settings: the cross-entropy method
with 3 iterations of 1,000 sequences of messages, each rolled 8 steps through transition, decoders,
encoder and policy, with one fixed person. Decisions are those of rounds in fog of a driver whose
sight was inferred from 20 other rounds. Those of single moments are made four times each, of which
the quickest counts.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from time import perf_counter

import torch
import tyro

import mirror_ppl
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
from mirror_ppl.communication.planners import PlannerOptions, planner_of
from mirror_ppl.data import Demonstrations
from mirror_ppl.models import SelfModel

LEARNED, ROUNDS, RUNS = 20, 6, 4


@dataclass(frozen=True)
class Options:
    """What to time."""

    domain: str = "driving"
    """World, driving or highway; the setting is fog."""
    draws: int = 64
    """Posterior draws."""
    decisions: int = 30
    """Decisions, spread over recorded rounds."""
    threads: int = 2
    """Threads of torch."""


def main(options: Options) -> None:
    """Time decisions, and print the table."""
    torch.set_num_threads(options.threads)
    recordings = mirror_ppl.load_recordings(domain=options.domain, setting="fog").select_people([0])
    fit = mirror_ppl.infer(recordings, draws=options.draws, train_rounds=LEARNED, explore=0)
    person = Person(fit.human, fit.posterior.draws)
    domain, self_model = fit.human.domain, fit.human.self_model
    held_out = recordings.select_rounds(slice(LEARNED, None))
    pasts = moments(held_out, options.decisions)
    channels = Channels(domain)
    counts = [2 ** int(channels.join(domain.communicable(past.now)).sum()) for past in pasts]
    print(
        f"{options.draws} draws, {person.percept_count} distinct ways to see; messages: median "
        f"{median(counts):.0f}, most {max(counts)}; {options.threads} threads",
        file=sys.stderr,
    )
    times = {}
    for name, planner in planners(options.domain, person).items():
        number = 3 if isinstance(planner.search, CrossEntropy) else len(pasts)
        times[name] = [timed(lambda p=planner, x=past: p.plan(x)) for past in pasts[:number]]
    # Beliefs are kept from step to step, so that each decision is made once.
    looping = mirror_ppl.Communicator(fit)
    times["the default, step by step, with hearing inferred"] = [
        timed(lambda x=past: looping.plan(x), runs=1)
        for number in range(ROUNDS)
        for past in steps(held_out, number)
    ]
    times["released settings: 3 x 1,000 sequences, 8 steps"] = [
        timed(lambda: released(self_model)) for _ in range(3)
    ]
    print(f"{'a decision':<50} {'median ms':>10} {'slowest ms':>11}")
    for name, values in times.items():
        print(f"{name:<50} {1e3 * median(values):>10.1f} {1e3 * max(values):>11.1f}")


def planners(domain: str, person: Person) -> dict[str, Communicator]:
    """Planners by what the table calls them, the default last."""
    found = {}
    if domain == "driving":
        simulator = SimulatorWorld(person.human.domain)
        for name, world, search in (
            ("every message, simulator", simulator, Exhaustive()),
            ("every message, self-model", SelfModelWorld(person.human.self_model), Exhaustive()),
            ("and plans of 3 steps", simulator, Patient()),
            ("cross-entropy, plans of 3 steps", simulator, CrossEntropy(3)),
        ):
            found[name] = Communicator(person, ExpectedUtility(world, 6), search)
    options = PlannerOptions.of(domain, hears=1.0)
    return found | {"the default": planner_of("mirror", person, options, 0)}


def steps(recordings: Demonstrations, number: int) -> list[RoundSoFar]:
    """Moments of a recorded round, one after another."""
    last = int((recordings.actions[0, number] >= 0).sum())
    person = recordings.people[0]
    return [RoundSoFar.of(recordings, person, number, step) for step in range(last)]


def moments(recordings: Demonstrations, number: int) -> list[RoundSoFar]:
    """Moments of recorded rounds, spread over their first halves, with no messages so far."""
    found = []
    for index in range(number):
        round_steps = steps(recordings, index % ROUNDS)
        found.append(round_steps[index * 7 % (len(round_steps) // 2)])
    return found


def timed(work: Callable[[], object], runs: int = RUNS) -> float:
    """Seconds of the quickest of some runs, so that what else the machine does hardly counts."""
    times = []
    for _ in range(runs):
        began = perf_counter()
        work()
        times.append(perf_counter() - began)
    return min(times)


@torch.no_grad()
def released(self_model: SelfModel, iterations: int = 3, samples: int = 1000, steps: int = 8):
    """The arithmetic of the released planner's settings on these networks."""
    domain = self_model.domain
    channels = Channels(domain)
    for _ in range(iterations):
        robot = torch.zeros(samples, self_model.latent)
        person = torch.zeros(samples, self_model.latent)
        action = torch.zeros(samples, dtype=torch.long)
        total = torch.zeros(samples)
        told = torch.rand(samples, steps // 2, len(channels)) < 0.35
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

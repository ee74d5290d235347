r"""What highway messages lose to the greedy oracle at a decision, and why: for docs/highway.md.

    python -m mirror_ppl.fit --domain highway --setting fog --population diverse \
        --train-rounds 20 --explore 0 --out runs/highway_0
    python -m benchmarks.highway_gap runs/highway_0/posterior.nc
    python -m benchmarks.highway_gap runs/highway_0/posterior.nc --receive mirror --rounds 2
    python -m mirror_ppl.simulate --domain highway --setting fog --population diverse \
        --people 10 --rounds 20 --seed 1 --out runs/highway_1.nc
    python -m mirror_ppl.fit --demos runs/highway_1.nc --train-rounds 20 --explore 0 \
        --out runs/highway_1
    python -m benchmarks.highway_gap runs/highway_1/posterior.nc --receive mirror --rounds 4 \
        --seed 1

Simulated drivers play rounds in silence, or receive messages of ``mirror``. At every sixth decision
messages of up to two items are chosen in several ways, and judged as the oracle judges them: by the
driver's true choices and the expert's values of the true state, less the cost. This writes a row
for each driver to docs/results/highway_gap.csv. Without a file, the table of the rows that are
there is printed, in which decisions count alike.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import mirror_ppl
from benchmarks._rows import rows_in
from mirror_ppl.communication.communicator import choose
from mirror_ppl.communication.messages import Channels, every_message
from mirror_ppl.communication.objectives import Valued, predicted_choices, robot_values
from mirror_ppl.communication.person import PlanningContext
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.highway import Highway, expert
from mirror_ppl.people import simulated_people
from mirror_ppl.randomness import person_id

ROWS = Path(__file__).parents[1] / "docs/results/highway_gap.csv"
EVERY = 6
"""Decisions from one that is looked at to the next."""
WAYS = {
    "best": "the best message",
    "mirror": "`mirror`: predicted choices, the robot's values",
    "true_values": "predicted choices, the expert's values of the true state",
    "true_choices": "the driver's true choices, the robot's values",
    "estimated_state": "true choices, the expert's values of the state estimated from the lidar",
}
"""Ways to choose a message, by the names of columns."""
RECEIVED = ("none", "mirror")
"""What drivers receive in the rounds that are looked at."""


def gains(
    planner: mirror_ppl.Communicator,
    past: RoundSoFar,
    true: Tensor,
    values: Tensor,
    messages: Tensor,
) -> dict[str, float]:
    """Return the true gain over silence of what each way chooses at one decision.

    Args:
        planner: with the posterior of the driver.
        past: the round so far.
        true: probabilities of the driver's manoeuvres after each message, ``[C, A]``.
        values: the expert's, of the true state, ``[A]``.
        messages: candidates ``[C, N]``, silence first.
    """
    human = planner.person.human
    cost = Channels(human.domain).cost(messages)
    context = PlanningContext.of(planner.person, past)
    predicted, robot = predicted_choices(context, messages), robot_values(human.self_model, past)
    estimated = expert.values(human.domain.state_behind({n: v[None] for n, v in past.now.items()}))

    def chosen(probabilities: Tensor, worth: Tensor) -> int:
        """Choose by probabilities ``[S, C, A]`` and values ``[A]``, as the planner does."""
        utility = (probabilities @ worth).T - cost[:, None]
        return choose(Valued(utility, None), planner.min_standard_errors)

    gain = true @ values - cost
    gain = gain - gain[0]
    sent = planner.plan(past).flags
    return {
        "best": float(gain.max()),
        "mirror": float(gain[int((messages == sent).all(-1).nonzero()[0])]),
        "true_values": float(gain[chosen(predicted, values)]),
        "true_choices": float(gain[chosen(true[None], robot)]),
        "estimated_state": float(gain[chosen(true[None], estimated[0])]),
    }


@torch.no_grad()
def measured(path: Path, people: int, rounds: int, seed: int, receive: str) -> list[dict[str, str]]:
    """Return a row for each driver: means over the decisions that were looked at."""
    world = Highway()
    channels = Channels(world)
    drivers = simulated_people("highway", "fog", "diverse", people, seed)
    generator = torch.Generator().manual_seed(seed)
    state = map_state(
        lambda part: part.view(people, rounds, *part.shape[1:]),
        world.initial(people * rounds, generator),
    )
    names = [person_id(number) for number in range(people)]
    planners = [mirror_ppl.Communicator(path, name) for name in names]
    memory, observation = drivers.start(rounds), world.observe(state)
    past = [
        [RoundSoFar.begin(world, _at(observation, one, two)) for two in range(rounds)]
        for one in range(people)
    ]
    found: list[list[dict[str, float]]] = [[] for _ in names]
    for step in range(world.horizon):
        values = expert.values(state)
        sent = torch.zeros(people, rounds, len(channels), dtype=torch.bool)
        for one in range(people * (step % EVERY == EVERY - 1)):
            driver = drivers.select([one])
            for two in range(rounds):
                if bool(world.over(state)[one, two]):
                    continue
                now = _at(observation, one, two)
                messages = every_message(channels.join(world.communicable(now)), 2)
                many = len(messages)
                true, _ = driver.step(
                    map_state(
                        lambda part: part[one, two].expand(many, *part.shape[2:])[None],  # noqa: B023
                        memory,
                    ),
                    {n: part.expand(many, *part.shape)[None] for n, part in now.items()},
                    channels.split(messages[None]),
                )
                found[one].append(
                    gains(planners[one], past[one][two], true[0], values[one, two], messages)
                )
        if receive == "mirror":
            for one, planner in enumerate(planners):
                for two in range(rounds):
                    sent[one, two] = planner.plan(past[one][two]).flags
        told = channels.split(sent)
        probabilities, memory = drivers.step(memory, observation, told)
        action = torch.multinomial(probabilities.flatten(0, 1), 1, generator=generator)
        action = action.view(people, rounds)
        state = world.transition(state, action)
        observation = world.observe(state)
        for one in range(people):
            for two in range(rounds):
                past[one][two] = past[one][two].then(
                    _at(told, one, two), action[one, two], _at(observation, one, two)
                )
        print(f"decision {step + 1} of {world.horizon}", end="\r", flush=True)
    return [
        {"receive": receive, "seed": str(seed), "person": name, "decisions": str(len(own))}
        | {way: f"{np.mean([gain[way] for gain in own]):.4f}" for way in WAYS}
        for name, own in zip(names, found, strict=True)
    ]


def _at(parts: dict[str, Tensor], one: int, two: int) -> dict[str, Tensor]:
    return {name: part[one, two] for name, part in parts.items()}


def share_of_best(gain: np.ndarray, best: np.ndarray) -> str:
    """Return drivers' gains ``[n]`` in % of the best, with the interval over drivers."""
    drawn = np.random.default_rng(0).integers(len(gain), size=(10_000, len(gain)))
    low, high = np.quantile(100 * gain[drawn].sum(1) / best[drawn].sum(1), (0.05, 0.95))
    return f"{100 * gain.sum() / best.sum():.0f} [{low:.0f}, {high:.0f}]"


def table(rows: Sequence[dict[str, str]]) -> str:
    """Return the table of the page; intervals are of a bootstrap over drivers."""
    lines = [
        "| Message chosen by | Gain in silence | % of the best | "
        "Gain with `mirror` | % of the best |",
        "|---|---|---|---|---|",
    ]
    cells = {way: [f"| {label}"] for way, label in WAYS.items()}
    for receive in RECEIVED:
        some = [row for row in rows if row["receive"] == receive]
        decisions = np.array([int(row["decisions"]) for row in some])
        sums = {way: decisions * np.array([float(row[way]) for row in some]) for way in WAYS}
        for way, gain in sums.items():
            interval = "" if way == "best" else share_of_best(gain, sums["best"])
            cells[way] += [f"{gain.sum() / decisions.sum():.1f}", interval]
    return "\n".join([*lines, *(" | ".join(own) + " |" for own in cells.values())])


def main() -> None:
    """Measure with a posterior, if one is given, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", nargs="?", type=Path, help="posterior of simulated drivers")
    parser.add_argument("--people", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0, help="of the drivers")
    parser.add_argument("--receive", choices=RECEIVED, default="none", help="messages they receive")
    given = parser.parse_args()
    rows = rows_in(ROWS)
    if given.file is not None:
        again = (given.receive, str(given.seed))
        kept = [row for row in rows if (row["receive"], row["seed"]) != again]
        new = measured(given.file, given.people, given.rounds, given.seed, given.receive)
        rows = rows_in(ROWS, kept + new)
    print(table(rows))


if __name__ == "__main__":
    main()

"""What an amortized guide should learn from: inference compilation, the ELBO, or a mix of them.

The network that ships was trained by inference compilation alone. Here it takes gradient steps of
the ELBO, or such steps in turns with steps of inference compilation on the same people; another
network takes gradient steps of the ELBO alone. Measured on people of other seeds: effective number
of draws of one stage of proposals, besides the draws from the prior that every stage has, and
Pareto k. ``refined`` networks take steps on each person's own rounds first (``fit --refine``).
"""

from __future__ import annotations

import argparse
import copy
import csv
from collections.abc import Iterator, Sequence
from itertools import cycle, islice
from pathlib import Path

import numpy as np
import torch

from mirror_ppl.inference.adaptive_importance import ImportanceOptions
from mirror_ppl.inference.amortized import AmortizedOptions, sample_amortized
from mirror_ppl.inference.amortized_guide import (
    PRIOR_DRAWS,
    AmortizedGuide,
    guide_screening,
    reference_places,
)
from mirror_ppl.inference.calibration.study import prior_people
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models import HumanModel
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.guide_elbo import (
    STEPS_OF_A_GROUP,
    ELBOTraining,
    Group,
    simulated_groups,
)
from mirror_ppl.training.guide_file import network_for

ROUNDS = (1, 2, 3, 5, 8, 13, 20)
TESTED_ROUNDS = (5, 20)
LEARNING_RATE = 3e-4
PROPOSALS = 512


def by_elbo(network: AmortizedGuide, groups: Sequence[Group], steps: int, turns: bool) -> None:
    """Gradient steps of the ELBO, in turns with steps of inference compilation or not."""
    adam = torch.optim.Adam(network.parameters(), LEARNING_RATE)
    current: list[Group] = []

    def noted() -> Iterator[Group]:
        for group in cycle(groups):
            current[:] = [group]
            yield group

    torch.manual_seed(0)
    network.train()
    training = ELBOTraining(network, noted(), LEARNING_RATE)
    for _ in range(steps):
        training.step()
        if turns:
            (group,) = current
            adam.zero_grad()
            density = network.density(group.log_evidence[:, 0], group.steps[:, 0])
            (-density.log_prob(group.place).mean()).backward()
            adam.step()
    network.eval()


def tested_people(
    human: HumanModel, people: int, seed: int
) -> list[tuple[int, int, ViewTableBuilder]]:
    """Number of rounds, person, and what their rounds say."""
    generator = torch.Generator().manual_seed(seed)
    implants = prior_people(human, people, generator)
    setting = human.domain.settings[-1]
    recordings = play_rounds(human, implants, max(TESTED_ROUNDS), setting, generator)
    found = []
    for person in range(people):
        builder = ViewTableBuilder(human, guide_screening())
        for number, one_round in enumerate(rounds_of(recordings, person).each(), 1):
            builder.add(one_round)
            if number in TESTED_ROUNDS:
                found.append((number, person, copy.deepcopy(builder, {id(human): human})))
    return found


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--domain", default="driving")
    parser.add_argument("--people", type=int, default=24)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--refine", type=int, default=50)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path("runs/guide_mix.csv"))
    options = parser.parse_args()
    human = HumanModel(load_self_model(shipped_weights(options.domain))[0])
    shipped = network_for("amortized", None, human)
    assert shipped is not None
    untrained = AmortizedGuide(reference_places(human), reference_places(human, PRIOR_DRAWS)).eval()
    tested = tested_people(human, options.people, options.seed)
    print("tested people are compiled", flush=True)
    rows: list[dict] = []

    def measure(name: str, network: AmortizedGuide, refine: int = 0) -> None:
        settings = AmortizedOptions(PROPOSALS, ImportanceOptions(stages=0), refine)
        for rounds, person, builder in tested:
            torch.manual_seed(person)
            found = sample_amortized(human, network, builder, settings)
            row = {"mix": name, "rounds": rounds, "person": person}
            rows.append(row | {"effective": found.effective, "pareto_k": found.pareto_k})
        for rounds in TESTED_ROUNDS:
            own = [row for row in rows if row["mix"] == name and row["rounds"] == rounds]
            draws = np.array([row["effective"] for row in own])
            high = np.mean([row["pareto_k"] > 0.7 for row in own])
            print(
                f"{name:40} {rounds:3} rounds: median {np.median(draws):6.1f}, "
                f"10% {np.quantile(draws, 0.1):6.1f}, k > 0.7: {high:.2f}",
                flush=True,
            )

    measure("untrained", untrained)
    measure("inference compilation", shipped)
    if options.refine:
        measure("inference compilation, refined", shipped, options.refine)
    number = -(-options.steps // STEPS_OF_A_GROUP)
    generator = torch.Generator().manual_seed(0)
    groups = list(islice(simulated_groups(human, ROUNDS, generator), number))
    print("groups are compiled", flush=True)
    for name, start, turns in (
        ("ELBO", untrained, False),
        ("inference compilation, then ELBO", shipped, False),
        ("inference compilation, then both in turns", shipped, True),
    ):
        network = copy.deepcopy(start)
        by_elbo(network, groups, options.steps, turns)
        measure(name, network)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()

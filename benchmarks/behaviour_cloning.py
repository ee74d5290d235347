"""How well behaviour clones predict people: held-out NLL against the number of training rounds.

For each population and seed, ten simulated people are cloned from their first rounds, with rounds
20-29 for validation, and tested on rounds 30-35 (counted from 0). More training rounds than 20 come
from another recording of the same people. Printed are means over people, in nats per action: the
floor (mean entropy of the people's own choices), what the frequencies of each person's actions in
20 rounds alone give, and the clones of both sights (see `mirror_ppl.baselines.behaviour_cloning`),
for each seed and the mean over seeds.
"""

from __future__ import annotations

import argparse
from functools import cache
from statistics import mean
from time import monotonic

import torch

from mirror_ppl.baselines import (
    SIGHTS,
    BehaviourCloneOptions,
    fit_behaviour_clone,
    held_out_nll,
)
from mirror_ppl.data import Demonstrations
from mirror_ppl.people import simulate

PEOPLE = 10
ROUNDS = 40
TRAINING = 20
"""Rounds before the validation rounds."""
VALIDATION, TEST = slice(20, 30), slice(30, 36)


@cache
def recordings(setting: str, population: str, seed: int, rounds: int = ROUNDS) -> Demonstrations:
    """Rounds of ten simulated people."""
    return simulate("driving", setting, population, PEOPLE, rounds, seed)


def frequency_nll(train: Demonstrations, test: Demonstrations) -> float:
    """NLL of the test rounds by the frequencies of each person's actions, one added to each."""
    frequencies = []
    for part, extra in ((train, 1), (test, 0)):
        chosen = torch.stack([(part.actions == a).sum((1, 2)) + extra for a in range(2)], -1)
        frequencies.append(chosen / chosen.sum(-1, keepdim=True))
    return -(frequencies[1] * frequencies[0].log()).sum(-1).mean().item()


def study(setting: str, population: str, seeds: list[int], numbers: list[int]) -> None:
    """Clone the people of a population and print the results."""
    floors, frequencies = [], []
    for seed in seeds:
        rounds = recordings(setting, population, seed)
        test = rounds.select_rounds(TEST)
        assert test.action_entropy is not None
        floors.append(test.action_entropy[test.mask].mean().item())
        frequencies.append(frequency_nll(rounds.select_rounds(slice(TRAINING)), test))
    show(f"{population:8s} floor", floors)
    show(f"{population:8s} frequencies alone", frequencies)
    for sight in SIGHTS:
        for number in numbers:
            began, nlls = monotonic(), []
            for seed in seeds:
                rounds = recordings(setting, population, seed)
                source = rounds
                if number > TRAINING:
                    source = recordings(setting, population, seed, number)
                clone = fit_behaviour_clone(
                    source.select_rounds(slice(number)),
                    rounds.select_rounds(VALIDATION),
                    BehaviourCloneOptions(sight=sight),
                    seed,
                )
                nlls.append(held_out_nll(clone, rounds.select_rounds(TEST)).mean().item())
            name = f"{population:8s} sight {sight}, {number} rounds"
            show(name, nlls, f"  {monotonic() - began:.0f} s")


def show(name: str, values: list[float], note: str = "") -> None:
    """Print the mean over seeds and the value of each."""
    each = "  ".join(f"{value:.3f}" for value in values)
    print(f"{name:38s} {mean(values):.3f}   seeds {each}{note}", flush=True)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--setting", default="fog")
    parser.add_argument("--populations", nargs="+", default=["paper", "diverse"])
    parser.add_argument(
        "--rounds", nargs="+", type=int, default=[1, 5, 20], help="numbers, such as 1 5 20 200"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    options = parser.parse_args()
    torch.set_num_threads(1)
    began = monotonic()
    for population in options.populations:
        study(options.setting, population, options.seeds, options.rounds)
    print(f"{monotonic() - began:.0f} s in all")


if __name__ == "__main__":
    main()

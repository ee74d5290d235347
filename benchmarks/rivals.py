"""The search for the settings of the rivals: which suit each domain.

For each domain, in the setting in which people see least, ten simulated people of other seeds than
those of the comparisons are learned by every combination of a few settings, from 5 and 20 rounds.
Printed is the mean NLL of their validation rounds in nats an action, the best first: those are the
settings that ``mirror_ppl.baselines`` has for the domain. Rounds by which they are compared are not
looked at.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from itertools import product
from statistics import mean
from time import monotonic
from typing import Any

import torch

from mirror_ppl.baselines import (
    BehaviourCloneOptions,
    SoftQOptions,
    fit_behaviour_clone,
    fit_soft_q,
    held_out_nll,
)
from mirror_ppl.domains import get_domain
from mirror_ppl.people import simulate

PEOPLE, RECORDED = 10, 30
TRAINING, VALIDATION = (5, 20), slice(20, 30)
SEEDS = (100, 101)
GRIDS: Mapping[str, Mapping[str, tuple[Any, ...]]] = {
    "bc": {"learning_rate": (0.01, 0.03), "weight_decay": (0.3, 1.0, 3.0, 6.0, 12.0)},
    "sqil": {
        "reward": (2.0, 5.0, 10.0),
        "discount": (0.0, 0.5, 0.9),
        "weight_decay": (0.1, 0.3, 1.0),
    },
}


def search(domain: str, model: str, seeds: list[int], told: float) -> None:
    """Try every combination and print them, the best first."""
    grid = GRIDS[model]
    setting = get_domain(domain).settings[-1]
    found = []
    for chosen in product(*grid.values()):
        began, own = monotonic(), dict(zip(grid, chosen, strict=True))
        nlls = {number: [] for number in TRAINING}
        for seed in seeds:
            rounds = simulate(domain, setting, "paper", PEOPLE, RECORDED, seed, told=told)
            validation = rounds.select_rounds(VALIDATION)
            for number in TRAINING:
                train = rounds.select_rounds(slice(number))
                if model == "bc":
                    options = BehaviourCloneOptions(**own)
                    networks = fit_behaviour_clone(train, validation, options, seed)
                else:
                    networks = fit_soft_q(train, validation, SoftQOptions(**own), seed)
                nlls[number].append(held_out_nll(networks, validation).mean().item())
        means = [mean(some) for some in nlls.values()]
        found.append((mean(means), means, own, monotonic() - began))
        print(f"  tried {_text(own)}: {means[0]:.3f} {means[1]:.3f}", flush=True)
    print(f"{domain}, {setting}, {model}: nats an action of {TRAINING[0]} and {TRAINING[1]} rounds")
    for _, means, own, seconds in sorted(found, key=lambda one: one[0]):
        print(f"  {means[0]:.3f} {means[1]:.3f}  {_text(own)}  {seconds:.0f} s", flush=True)


def _text(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in settings.items())


def main() -> None:
    """Run the search."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--domains", nargs="+", default=["driving", "search_rescue", "bomb_defusal"]
    )
    parser.add_argument("--models", nargs="+", default=list(GRIDS), choices=list(GRIDS))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--told", type=float, default=0.0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for domain in options.domains:
        for model in options.models:
            search(domain, model, options.seeds, options.told)


if __name__ == "__main__":
    main()

"""The search for the settings of the rivals: which suit each domain.

    python -m benchmarks.rivals

For each domain, in the setting in which people see least, ten simulated people of other seeds than
those of the comparisons are learned from 5 and 20 rounds. One setting after another is varied, the
others being at the best so far, or as they are in the package; printed is the mean NLL of the
people's validation rounds in nats an action. What is best of a domain is what
``mirror_ppl.baselines`` has for it. Rounds by which models are compared are not looked at.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
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
from mirror_ppl.baselines.training import TrainingOptions
from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.people import simulate

PEOPLE, RECORDED = 10, 30
TRAINING, VALIDATION = (5, 20), slice(20, 30)
SEEDS = (100, 101)
OPTIONS: Mapping[str, Any] = {"bc": BehaviourCloneOptions, "sqil": SoftQOptions}
GRIDS: Mapping[str, Mapping[str, tuple[Any, ...]]] = {
    "bc": {"weight_decay": (0.3, 1.0, 3.0, 6.0, 12.0), "learning_rate": (0.01, 0.03)},
    "sqil": {
        "learning_rate": (0.01, 0.02, 0.03),
        "reward": (2.0, 5.0, 10.0),
        "discount": (0.0, 0.5, 0.9),
        "weight_decay": (0.03, 0.1, 0.3, 1.0),
    },
}
"""Values of each setting, in the order in which they are varied."""


def search(domain: str, model: str, seeds: list[int]) -> None:
    """Vary one setting after another and print what was best."""
    setting = get_domain(domain).settings[-1]
    recorded = {seed: simulate(domain, setting, "paper", PEOPLE, RECORDED, seed) for seed in seeds}
    print(f"{domain}, {setting}, {model}: nats an action of {TRAINING[0]} and {TRAINING[1]} rounds")
    best: dict[str, Any] = {}
    done: dict[TrainingOptions, float] = {}
    for name, values in GRIDS[model].items():
        losses = {}
        for value in values:
            tried = best | {name: value}
            options = OPTIONS[model].of(domain, **tried)
            if options not in done:
                began = monotonic()
                means = [_loss(recorded, number, options) for number in TRAINING]
                done[options] = mean(means)
                text = " ".join(f"{one:.3f}" for one in means)
                print(f"  {text}  {_text(tried)}  {monotonic() - began:.0f} s", flush=True)
            losses[value] = done[options]
        best[name] = min(losses, key=losses.__getitem__)
    print(f"  best: {_text(best)}", flush=True)


def _loss(recorded: Mapping[int, Demonstrations], number: int, options: TrainingOptions) -> float:
    """NLL of validation rounds, with so many rounds to learn from; the mean over seeds."""
    losses = []
    for seed, rounds in recorded.items():
        train, validation = rounds.select_rounds(slice(number)), rounds.select_rounds(VALIDATION)
        if isinstance(options, SoftQOptions):
            networks = fit_soft_q(train, validation, options, seed)
        else:
            assert isinstance(options, BehaviourCloneOptions)
            networks = fit_behaviour_clone(train, validation, options, seed)
        losses.append(held_out_nll(networks, validation).mean().item())
    return mean(losses)


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
    options = parser.parse_args()
    torch.set_num_threads(1)
    for domain in options.domains:
        for model in options.models:
            search(domain, model, options.seeds)


if __name__ == "__main__":
    main()

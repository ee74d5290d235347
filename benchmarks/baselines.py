"""The search for the settings of the baselines: which suit each domain.

    python -m benchmarks.baselines

In each domain, whatever people see, ten simulated people of other seeds than those of the
comparisons are learned from 5 and 20 rounds. One option after another is varied, the others being
at the best so far, or as they are in the package; printed is the mean NLL of the people's
validation rounds in nats an action, in each setting of the domain. What has the least mean is what
``mirror_ppl.baselines`` has for the domain. Rounds by which models are compared are not looked at.
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
from mirror_ppl.evaluation.learners import VALIDATION
from mirror_ppl.people import simulate

PEOPLE, RECORDED = 10, VALIDATION.stop
TRAINING = 5, 20
SEEDS = (100, 101)
"""Of people."""
SEED = 100
"""Of networks."""
OPTIONS: Mapping[str, Any] = {"bc": BehaviourCloneOptions, "sqil": SoftQOptions}
GRIDS: Mapping[str, Mapping[str, tuple[Any, ...]]] = {
    "bc": {
        "learning_rate": (0.001, 0.003, 0.01, 0.03, 0.06),
        "weight_decay": (0.1, 0.3, 1.0, 3.0, 6.0, 12.0),
    },
    "sqil": {
        "learning_rate": (0.003, 0.01, 0.02, 0.03, 0.05),
        "reward": (2.0, 5.0, 10.0, 20.0),
        "discount": (0.0, 0.5, 0.9),
        "weight_decay": (0.03, 0.1, 0.3, 1.0),
    },
}
"""Values of each option, in the order in which they are varied."""


def search(domain: str, model: str, settings: list[str], seeds: list[int]) -> None:
    """Vary one option after another and print what was best."""
    people = [
        [simulate(domain, setting, "paper", PEOPLE, RECORDED, seed) for seed in seeds]
        for setting in settings
    ]
    where = " and ".join(f"{setting}, {number}" for setting in settings for number in TRAINING)
    print(f"{domain}, {model}: nats an action of {where} rounds", flush=True)
    best: dict[str, Any] = {}
    done: dict[TrainingOptions, float] = {}
    for name, values in GRIDS[model].items():
        losses = {}
        for value in values:
            tried = best | {name: value}
            options = OPTIONS[model].of(domain, **tried)
            if options not in done:
                began = monotonic()
                means = [_loss(own, number, options) for own in people for number in TRAINING]
                done[options] = mean(means)
                text = " ".join(f"{one:.3f}" for one in means)
                print(f"  {text}  {_text(tried)}  {monotonic() - began:.0f} s", flush=True)
            losses[value] = done[options]
        best[name] = min(losses, key=losses.__getitem__)
    print(f"  best: {_text(best)}", flush=True)


def _loss(recorded: list[Demonstrations], number: int, options: TrainingOptions) -> float:
    """NLL of validation rounds, with so many rounds to learn from; the mean over seeds."""
    losses = []
    for rounds in recorded:
        train, validation = rounds.select_rounds(slice(number)), rounds.select_rounds(VALIDATION)
        if isinstance(options, SoftQOptions):
            networks = fit_soft_q(train, validation, options, SEED)
        else:
            assert isinstance(options, BehaviourCloneOptions)
            networks = fit_behaviour_clone(train, validation, options, SEED)
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
    parser.add_argument("--settings", nargs="+", help="all of each domain unless given")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    for domain in options.domains:
        for model in options.models:
            search(domain, model, options.settings or [*get_domain(domain).settings], options.seeds)


if __name__ == "__main__":
    main()

"""What a population is worth: held-out predictions of new people, with and without it as a prior.

A population is inferred from some people with all their training rounds. Others, whom it has never
seen, are then inferred from no round, one and so on, under the human model's own prior and under
the population. Printed is the negative log-likelihood of their held-out actions in nats above their
own entropy, and the mean difference with its standard error over people.

With ``--together`` the same people are inferred alone and together with the population that they
are from, as `fit --pooling partial` does; beside that, how many true thresholds 90% intervals hold.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.population.pooling import Population
from mirror_ppl.inference.results.fitting import fit_people, split_rounds
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--settings", nargs="+", default=["fog"])
    parser.add_argument("--populations", nargs="+", default=["paper", "diverse"])
    parser.add_argument("--people", type=int, default=10)
    parser.add_argument("--others", type=int, default=20)
    parser.add_argument("--rounds", type=int, nargs="+", default=[0, 1, 5, 20])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--together", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    self_model, _ = load_self_model(shipped_weights("driving"))
    human = HumanModel(self_model)
    for setting in options.settings:
        for kind in options.populations:
            print(f"{setting}, {kind}: nats above the people's own entropy", flush=True)
            if options.together:
                for rounds in options.rounds:
                    same_people(human, (setting, kind, options.people), options.seed, rounds)
                continue
            seen = simulate("driving", setting, kind, options.people, 40, 2 * options.seed)
            new = simulate("driving", setting, kind, options.others, 40, 2 * options.seed + 1)
            partial = InferenceOptions(pooling="partial")
            found = infer(human, split_rounds(seen)[0], partial, 0).population
            for rounds in options.rounds:
                alone, pooled = (
                    above_floor(human, new, rounds, population) for population in (None, found)
                )
                gain = alone - pooled
                error = float(gain.std() / len(gain) ** 0.5)
                means = [f"{float(value.mean()):.3f}" for value in (alone, pooled, gain)]
                print(
                    f"  {rounds:2d} rounds: alone {means[0]}, with the population {means[1]}, "
                    f"difference {means[2]} +- {error:.3f}",
                    flush=True,
                )


def same_people(human: HumanModel, who: tuple[str, str, int], seed: int, rounds: int) -> None:
    """Print what inferring people together brings after so many rounds of each."""
    people = simulate("driving", who[0], who[1], who[2], 40, seed)
    found, held = [], []
    for pooling in ("none", "partial"):
        fit = fit_people(human, people, InferenceOptions(pooling=pooling), 0, rounds)
        tests = [person["test"] for person in fit.summary["people"]]
        found.append(torch.tensor([test["nll"] - test["floor"] for test in tests]))
        implants = [person["implants"] for person in fit.summary["people"]]
        inside = [
            own[site]["q05"] <= own[site]["truth"] <= own[site]["q95"]
            for own in implants
            for site in sight_sites(human.domain)
        ]
        held.append(f"{sum(inside)} of {len(inside)}")
    gain = found[0] - found[1]
    error = float(gain.std() / len(gain) ** 0.5)
    means = [f"{float(value.mean()):.3f}" for value in (*found, gain)]
    print(
        f"  {rounds:2d} rounds: alone {means[0]} (held {held[0]}), together {means[1]} "
        f"(held {held[1]}), difference {means[2]} +- {error:.3f}",
        flush=True,
    )


def above_floor(human: HumanModel, new, rounds: int, population: Population | None) -> Tensor:
    """Nats an action above their own entropy ``[P]``."""
    fit = fit_people(human, new, InferenceOptions(), 0, rounds, population=population)
    tests = [person["test"] for person in fit.summary["people"]]
    return torch.tensor([test["nll"] - test["floor"] for test in tests])


if __name__ == "__main__":
    main()

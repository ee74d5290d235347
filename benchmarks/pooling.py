"""What a population is worth: held-out predictions of new people, with and without it as a prior.

A population is inferred from some people with all their training rounds. Others, whom it has never
seen, are then inferred from no round, one and so on, under the human model's own prior and under
the population. Printed is the negative log-likelihood of their held-out actions in nats above their
own entropy, and the mean difference with its standard error over people.

With ``--together`` the same people are inferred alone and together with the population that they
are from, as `fit --pooling partial` does, and it is counted how many true thresholds 90% intervals
hold. This writes a row for each person to docs/results/pooling_together.csv, and prints the table
of all rows; what is there is not done again. The table of docs/trust.md is made by::

    python -m benchmarks.pooling --together --rounds 1 5 20 --seed 100

and so for seeds 101 and 102.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from benchmarks._rows import rows_in
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.population.pooling import Population
from mirror_ppl.inference.results.fitting import fit_people, split_rounds
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate

ROWS = Path(__file__).parents[1] / "docs/results/pooling_together.csv"


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
                print(together_table(rows_in(ROWS)))
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
    """Write what inferring people together brings after so many rounds of each, unless it is known.

    Args:
        human: the model of people.
        who: setting, population and number of people.
        seed: of the people.
        rounds: number of training rounds of each person.
    """
    setting, population, number = who
    where = {
        "setting": setting,
        "population": population,
        "seed": str(seed),
        "rounds": str(rounds),
    }
    rows = rows_in(ROWS) if ROWS.exists() else []
    kept = [row for row in rows if not where.items() <= row.items()]
    if len(rows) - len(kept) == number:
        return
    people = simulate("driving", setting, population, number, 40, seed)
    new = [where | {"person": name} for name in people.people]
    for name, pooling in (("alone", "none"), ("together", "partial")):
        fit = fit_people(human, people, InferenceOptions(pooling=pooling), 0, rounds)
        for row, person in zip(new, fit.summary["people"], strict=True):
            above = person["test"]["nll"] - person["test"]["floor"]
            own = [person["implants"][site] for site in sight_sites(human.domain)]
            inside = sum(one["q05"] <= one["truth"] <= one["q95"] for one in own)
            row |= {f"above_entropy_{name}": f"{above:.4f}", f"held_{name}": str(inside)}
    rows_in(ROWS, kept + new)


def together_table(rows: Sequence[dict[str, str]]) -> str:
    """Return the table of docs/trust.md, of people in fog; errors are over people."""
    rows = [row for row in rows if row["setting"] == "fog"]
    amounts = sorted({int(row["rounds"]) for row in rows})
    lines = [
        "| Together, against each alone: gain in nats per action ± standard error | "
        + " | ".join(f"{n} round{'s' * (n > 1)}" for n in amounts)
        + " | thresholds held: alone, together |",
        "|---|" + "---|" * (len(amounts) + 1),
    ]
    for population in dict.fromkeys(row["population"] for row in rows):
        own = [row for row in rows if row["population"] == population]
        cells = []
        for amount in amounts:
            gains = torch.tensor(
                [
                    float(row["above_entropy_alone"]) - float(row["above_entropy_together"])
                    for row in own
                    if int(row["rounds"]) == amount
                ]
            )
            error = float(gains.std() / len(gains) ** 0.5)
            cells.append(f"{float(gains.mean()):.3f} ± {error:.3f}".replace("0.", "."))
        alone, together = (
            sum(int(row[f"held_{name}"]) for row in own) for name in ("alone", "together")
        )
        held = f"{alone}, {together} of {4 * len(own)}"
        lines.append(f"| `{population}` | {' | '.join(cells)} | {held} |")
    return "\n".join(lines)


def above_floor(human: HumanModel, new, rounds: int, population: Population | None) -> Tensor:
    """Nats an action above their own entropy ``[P]``."""
    fit = fit_people(human, new, InferenceOptions(), 0, rounds, population=population)
    tests = [person["test"] for person in fit.summary["people"]]
    return torch.tensor([test["nll"] - test["floor"] for test in tests])


if __name__ == "__main__":
    main()

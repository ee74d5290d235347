"""Prior medians of consistency, compared by the marginal likelihood of recorded people.

    python -m benchmarks.consistency_prior --seeds 104 --medians 3 6 9 13 20
    python -m benchmarks.consistency_prior --seeds 1 2 3 --medians 3 13

Ten `paper` people of each seed are fitted with 1, 5 and 20 of 26 rounds in each setting of a world
(search and rescue unless `--world` names another one), with several prior medians of their
consistency (`Record.consistency`). The last six rounds are held out. This writes a row for each
person and number of rounds to docs/results/consistency_prior.csv; what is there is not measured
again. The table of docs/decisions.md is printed; medians are compared on seeds from 100 on.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby, product
from pathlib import Path

import numpy as np
import torch

import mirror_ppl
from benchmarks._rows import rows_in
from benchmarks.tables import TITLES
from benchmarks.value_errors import FIRST_TO_CHOOSE
from mirror_ppl.domains import DOMAINS
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate

ROWS = Path(__file__).parents[1] / "docs/results/consistency_prior.csv"
PEOPLE, ROUNDS, LEARNED = 10, 26, (1, 5, 20)


def measured(
    world: str, setting: str, seed: int, median: float, rounds: int
) -> Iterator[dict[str, str]]:
    """Yield a row for each person of a seed."""
    self_model, _ = load_self_model(shipped_weights(world), world)
    domain = self_model.domain
    human = load_human_model("mirror", self_model)
    domain.record = replace(domain.record, consistency=median)  # in this process
    recordings = simulate(world, setting, "paper", PEOPLE, ROUNDS, seed)
    recordings = recordings.select_rounds([*range(rounds), *range(max(LEARNED), ROUNDS)])
    fit = mirror_ppl.infer(
        recordings,
        human=human,
        engine="importance",
        train_rounds=rounds,
        explore=0,
        seed=seed,
    )
    for person in fit.summary["people"]:
        evidence = person["log_evidence"]
        yield {
            "world": world,
            "setting": setting,
            "seed": str(seed),
            "median": f"{median:g}",
            "rounds": str(rounds),
            "person": person["id"],
            "consistency": f"{person['implants']['consistency']['median']:.3f}",
            "log_evidence": "" if evidence is None else f"{evidence:.3f}",
            "nll": f"{person['test']['nll']:.4f}",
        }


def cell_of(row: dict[str, str]) -> tuple[str, ...]:
    """What is measured at once."""
    return tuple(row[name] for name in ("world", "setting", "seed", "median", "rounds"))


def table(rows: Sequence[dict[str, str]]) -> str:
    """Return a line for each world, setting, set of seeds and median."""
    lines = [
        "| World, setting, seeds | Prior median | Mean of posterior medians, 20 rounds "
        "| Log marginal likelihood of 20 rounds, nats a person "
        "| Held-out NLL, nats an action, with 1 round | 5 rounds | 20 rounds |",
        f"|{'---|' * 7}",
    ]

    def place(row: dict[str, str]) -> tuple:
        reported = int(row["seed"]) < FIRST_TO_CHOOSE
        return row["world"], row["setting"], reported, float(row["median"])

    for (world, setting, _, median), some in groupby(sorted(rows, key=place), place):
        own = list(some)
        seeds = sorted({int(row["seed"]) for row in own})
        name = TITLES.get(world, world.replace("_", " ").capitalize())
        evidence = _mean(own, "log_evidence", max(LEARNED))
        cells = [
            f"{name}, {setting}, {', '.join(map(str, seeds))}",
            f"{median:g}",
            f"{_mean(own, 'consistency', max(LEARNED)):.1f}",
            "" if math.isnan(evidence) else f"{evidence:.1f}",
            *(f"{_mean(own, 'nll', rounds):.4f}" for rounds in LEARNED),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _mean(rows: Sequence[dict[str, str]], name: str, rounds: int) -> float:
    """Mean of a column; not a number where some values are missing, as on the highway."""
    values = [row[name] for row in rows if row["rounds"] == str(rounds)]
    return math.nan if "" in values else float(np.mean([float(value) for value in values]))


def main() -> None:
    """Measure what is missing, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--world", default="search_rescue", choices=sorted(DOMAINS))
    parser.add_argument("--seeds", type=int, nargs="*", default=[], help="of people")
    parser.add_argument("--medians", type=float, nargs="*", default=[], help="per unit of reward")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = rows_in(ROWS) if ROWS.exists() else []
    settings = DOMAINS[given.world].settings
    for seed, setting, median, rounds in product(given.seeds, settings, given.medians, LEARNED):
        cell = given.world, setting, str(seed), f"{median:g}", str(rounds)
        if cell not in map(cell_of, rows):
            rows = rows_in(ROWS, rows + list(measured(given.world, setting, seed, median, rounds)))
            print(*cell, flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()

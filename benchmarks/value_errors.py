"""How large differences of values may be errors of the robot's network, in search and rescue.

    python -m benchmarks.value_errors --seeds 104 --errors 0 0.05 0.1 0.15 0.2
    python -m benchmarks.value_errors --seeds 1 2 3 --errors 0 0.15

Ten `paper` people of each seed are fitted (20 rounds of 26) in both settings, with human models of
different `Record.value_error`. This writes a row for each person to docs/results/value_errors.csv;
what is there is not measured again. The table of docs/decisions.md is printed; sizes are compared
on seeds from 100 on.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import mirror_ppl
from benchmarks._rows import rows_in
from mirror_ppl.models import HumanModel, SelfModel
from mirror_ppl.models.value_errors import beyond_errors
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate

ROWS = Path(__file__).parents[1] / "docs/results/value_errors.csv"
WORLD, SETTINGS = "search_rescue", ("clear", "smoke")
PEOPLE, ROUNDS, LEARNED = 10, 26, 20
FIRST_TO_CHOOSE = 100
"""Seed from which on people decide about settings of the software."""


class WithError(HumanModel):
    """The package's own human model with another size of errors."""

    def __init__(self, self_model: SelfModel, error: float) -> None:
        super().__init__(self_model)
        self.error = error

    def action_values(self, belief: Tensor) -> Tensor:
        """Return the robot's action values without differences that may be errors."""
        return beyond_errors(self.self_model.action_values(belief), self.error)


def measured(setting: str, seed: int, error: float) -> Iterator[dict[str, str]]:
    """Yield a row for each person of a seed."""
    human = WithError(load_self_model(shipped_weights(WORLD), WORLD)[0], error)
    recordings = simulate(WORLD, setting, "paper", PEOPLE, ROUNDS, seed)
    fit = mirror_ppl.infer(recordings, human=human, train_rounds=LEARNED, explore=0, seed=seed)
    for person in fit.summary["people"]:
        held = {
            name: int(own["q05"] <= own["truth"] <= own["q95"])
            for name, own in person["implants"].items()
            if own["truth"] is not None
        }
        yield {
            "seed": str(seed),
            "setting": setting,
            "person": person["id"],
            "error": f"{error:g}",
            "log_evidence": str(person["log_evidence"]),
            "nll": f"{person['test']['nll']:.4f}",
            "floor": f"{person['test']['floor']:.4f}",
            "radius_held": str(held["sight_radius"]),
            "lapse_held": str(held["lapse"]),
        }


def table(rows: list[dict[str, str]]) -> str:
    """Return a line for each setting, size of errors and kind of seeds."""
    lines = [
        "| People | Size of errors | Log evidence above none, nats | Held-out NLL, nats an action "
        "| 90% intervals hold the radius | and `lapse` |",
        f"|{'---|' * 6}",
    ]
    for setting in SETTINGS:
        for chosen in (True, False):
            some = [
                row
                for row in rows
                if row["setting"] == setting and (int(row["seed"]) >= FIRST_TO_CHOOSE) == chosen
            ]
            none = {
                (row["seed"], row["person"]): float(row["log_evidence"])
                for row in some
                if row["error"] == "0"
            }
            for error in sorted({row["error"] for row in some}, key=float):
                own = [row for row in some if row["error"] == error]
                ahead = [
                    float(row["log_evidence"]) - none[row["seed"], row["person"]] for row in own
                ]
                seeds = sorted({int(row["seed"]) for row in own})
                named = ("seed " if len(seeds) == 1 else "seeds ") + ", ".join(map(str, seeds))
                where = f"{setting}, {len(own)} of {named}"
                nll = np.mean([float(row["nll"]) for row in own])
                radius, lapse = (
                    sum(int(row[name]) for row in own) for name in ("radius_held", "lapse_held")
                )
                lines.append(
                    f"| {where} | {error} | {sum(ahead):+.1f} | {nll:.4f} | {radius} | {lapse} |"
                )
    return "\n".join(lines)


def main() -> None:
    """Measure what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="*", default=[], help="of people")
    parser.add_argument("--errors", type=float, nargs="*", default=[0.0], help="sizes, in reward")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = rows_in(ROWS) if ROWS.exists() else []
    errors = sorted({0.0, *given.errors})  # others are compared with none
    for seed, setting, error in product(given.seeds, SETTINGS, errors):
        cell = str(seed), setting, f"{error:g}"
        if cell not in {(row["seed"], row["setting"], row["error"]) for row in rows}:
            rows = rows_in(ROWS, rows + list(measured(setting, seed, error)))
            print(f"seed {seed}, {setting}, {error:g}", flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()

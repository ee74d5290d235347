"""How far values separate actions that are equally good, by which people would choose.

    python -m benchmarks.ties --worlds driving search_rescue bomb_defusal

Rounds are played with one random action in five. At each decision with several actions that are
exactly the best for an observer with some view, the robot's values of these actions differ by
errors of its network. Choices multiply what the human model leaves of a difference
(`Record.value_error`) by the person's consistency: a product of .05 or more is evidence where there
is none. Consistency is the mean over the posterior of ten simulated people (20 rounds, seed 0, the
setting in which they see most), of whom the median is taken. This writes docs/results/ties.csv; the
table of docs/self_model.md is printed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import mirror_ppl
from benchmarks._rows import rows_in
from benchmarks.tables import TITLES
from benchmarks.value_errors import WithError
from mirror_ppl.domains.base import roll_out
from mirror_ppl.evaluation.self_model import TIE, exact_values, robot_values, views_of
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.value_errors import beyond_errors
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.experience import drive
from mirror_ppl.training.self_model_options import SelfModelOptions

ROWS = Path(__file__).parents[1] / "docs/results/ties.csv"
WORLDS = "driving", "search_rescue", "bomb_defusal"
VIEWS = {"full": "everything shown and said", "clear": "everything shown"}
ROUNDS, EPSILON = 400, 0.2
AIM = 0.05


def separations(exact: Tensor, values: Tensor) -> np.ndarray:
    """Range of values ``[n]`` of the best actions, where these are several.

    Args:
        exact: exact action values ``[..., A]``.
        values: those of the robot or of a human model ``[..., A]``.
    """
    best = exact >= exact.amax(-1, keepdim=True) - TIE
    high = values.masked_fill(~best, -torch.inf).amax(-1)
    low = values.masked_fill(~best, torch.inf).amin(-1)
    return (high - low)[best.sum(-1) > 1].numpy()


def consistency(self_model: SelfModel, error: float) -> float:
    """Median over ten people of the posterior mean of consistency, with errors of a size."""
    world = self_model.domain
    human = None if error == world.record.value_error else WithError(self_model, error)
    recordings = mirror_ppl.load_recordings(domain=world.name, setting=world.settings[0])
    fit = mirror_ppl.infer(recordings, human=human, train_rounds=20, explore=0)
    return float(fit.posterior.draws["consistency"].mean(0).median())


@torch.no_grad()
def measured(world: str, seed: int) -> Iterator[dict[str, str]]:
    """Yield a row for each view, and for no value errors and those of the world."""
    self_model, _ = load_self_model(shipped_weights(world), world)
    domain = self_model.domain.as_believed
    generator = torch.Generator().manual_seed(seed)
    start = domain.initial(ROUNDS, generator)
    errors = sorted({0.0, domain.record.value_error})
    factors = {error: consistency(self_model, error) for error in errors}
    discount = domain.record.training.get("discount", SelfModelOptions.discount)
    for name, plan in views_of(domain, ROUNDS, generator).items():
        if not domain.settled and name not in VIEWS:
            continue
        actions = drive(self_model, start, plan, domain.horizon, generator, epsilon=EPSILON)
        under_way = ~domain.over(roll_out(domain, start, actions))[:, :-1]
        exact = exact_values(domain, start, actions, plan, discount)[under_way]
        values = robot_values(self_model, start, actions, plan)[under_way]
        for error, factor in factors.items():
            apart = separations(exact, beyond_errors(values, error))
            yield {
                "world": world,
                "view": name,
                "error": f"{error:g}",
                "consistency": f"{factor:.2f}",
                "share": f"{len(apart) / len(exact):.4f}",
                "difference": f"{apart.mean():.4f}" if len(apart) else "",
                "below": f"{(factor * apart < AIM).mean():.4f}" if len(apart) else "",
            }


def table(rows: Sequence[dict[str, str]]) -> str:
    """Return the table of docs/self_model.md."""
    lines = [
        "| World, view | Value errors | Consistency | Decisions with several best actions "
        "| Difference of their values, mean | times consistency | below .05 |",
        f"|{'---|' * 7}",
    ]
    for row in rows:
        name = TITLES.get(row["world"], row["world"].replace("_", " ").capitalize())
        view = VIEWS.get(row["view"], row["view"].replace("_", " "))
        cells = ["", "", ""]
        if row["difference"]:
            difference = float(row["difference"])
            product = difference * float(row["consistency"])
            cells = [f"{difference:.3f}", f"{product:.2f}", f"{100 * float(row['below']):.0f}%"]
        lines.append(
            f"| {name}, {view} | {row['error']} | {float(row['consistency']):.1f} "
            f"| {100 * float(row['share']):.0f}% | {' | '.join(cells)} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure some worlds anew, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", nargs="*", default=[], choices=WORLDS, help="to measure anew")
    parser.add_argument("--seed", type=int, default=3, help="of the rounds")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = rows_in(ROWS) if ROWS.exists() else []
    for world in given.worlds:
        others = [row for row in rows if row["world"] != world]
        rows = others + list(measured(world, given.seed))
        rows = rows_in(ROWS, sorted(rows, key=lambda row: WORLDS.index(row["world"])))
    print(table(rows))


if __name__ == "__main__":
    main()

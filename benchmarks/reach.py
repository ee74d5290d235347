r"""How often posteriors of drivers hold their true reach: the table of docs/highway.md.

    python -m mirror_ppl.fit --domain highway --setting fog --population diverse \
        --train-rounds 20 --explore 0 --out runs/highway_0
    python -m mirror_ppl.simulate --domain highway --setting fog --population diverse \
        --people 40 --rounds 20 --seed 1 --out runs/highway_1.nc
    python -m mirror_ppl.fit --demos runs/highway_1.nc --train-rounds 19 --explore 0 \
        --out runs/highway_1
    python -m benchmarks.reach runs/highway_0 runs/highway_1

The last command writes a row for each driver and direction to docs/results/highway_reach.csv, from
the summaries of these fits. Without folders it prints the table of the rows that are there.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from statistics import mean

from scipy.stats import beta

from benchmarks._rows import rows_in

ROWS = Path(__file__).parents[1] / "docs/results/highway_reach.csv"
SIGHT = "sight_"


def rows_of(folder: Path) -> list[dict[str, str]]:
    """Return rows of a fit: of each person, and each threshold of sight."""
    summary = json.loads((folder / "summary.json").read_text())
    rows = []
    for person in summary["people"]:
        check, implants = person["check"], person["implants"]
        own = {
            "fit": folder.name,
            "person": person["id"],
            "rounds": person["rounds"],
            "verdict": check["verdict"],
            "reasons": "; ".join(check["reasons"]),
            "pareto_k": f"{person['pareto_k']:.2f}",
            "assumes_clear": implants["assumes_clear"]["median"],
            "nll": f"{person['test']['nll']:.4f}",
            "floor": f"{person['test']['floor']:.4f}",
            "nll_base_rate": f"{check['nll_base_rate']:.4f}",
            "nll_no_implants": f"{check['nll_no_implants']:.4f}",
        }
        for site in (name for name in implants if name.startswith(SIGHT)):
            found = {name: implants[site][name] for name in ("truth", "q05", "median", "q95")}
            rows.append(own | {"direction": site.removeprefix(SIGHT)} | found)
    return [{name: str(value) for name, value in row.items()} for row in rows]


def table(rows: Sequence[dict[str, str]]) -> str:
    """Return the table of the page: of each direction, how often intervals hold the truth."""
    lines = [
        "| Reach | 90% interval holds it | Mean width, m | Mean error of the median, m |",
        "|---|---|---|---|",
    ]
    for direction in dict.fromkeys(row["direction"] for row in rows):
        own = [row for row in rows if row["direction"] == direction]
        low, truth, median, high = (
            [float(row[name]) for row in own] for name in ("q05", "truth", "median", "q95")
        )
        held = sum(a <= b <= c for a, b, c in zip(low, truth, high, strict=True))
        number = len(own)
        least = beta.ppf(0.05, held, number - held + 1) if held else 0.0
        most = beta.ppf(0.95, held + 1, number - held) if held < number else 1.0
        width = mean(b - a for a, b in zip(low, high, strict=True))
        error = mean(abs(a - b) for a, b in zip(median, truth, strict=True))
        share = f"{held} of {number}: {held / number:.0%} [{least:.0%}, {most:.0%}]"
        lines.append(f"| {direction.replace('_', ' ')} | {share} | {width:.1f} | {error:.1f} |")
    return "\n".join(lines)


def main() -> None:
    """Write the rows of fits, if some are given, and print their table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="*", type=Path, help="folders of fits")
    given = parser.parse_args().folders
    rows = rows_in(ROWS, [row for folder in given for row in rows_of(folder)])
    print(table(rows))
    people = list({(row["fit"], row["person"]): row for row in rows}.values())
    for name in ("nll", "floor", "nll_base_rate", "nll_no_implants"):
        print(f"{name}: {mean(float(row[name]) for row in people):.3f}")
    print(
        "assume clear:", sum(float(row["assumes_clear"]) == 1 for row in people), "of", len(people)
    )
    print("Pareto k above 0.7:", sum(float(row["pareto_k"]) > 0.7 for row in people))
    print("ok:", sum(row["verdict"] == "ok" for row in people))


if __name__ == "__main__":
    main()

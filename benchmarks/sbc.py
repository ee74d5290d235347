"""Simulation-based calibration of engines and human models: the table of docs/trust.md.

    python -m mirror_ppl.calibrate --human-model late --people 100 --out runs/late
    python -m benchmarks.sbc runs/late/calibration.nc

The last command puts a row for each implant and number of rounds into docs/results/calibration.csv,
in place of those of the same world, human model and engine, and prints the table of all rows.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks._rows import rows_in
from mirror_ppl.inference.calibration.ranks import FAILURE_RATE, LEVELS, Calibration
from mirror_ppl.models.variants import VARIANTS

ROWS = Path(__file__).parents[1] / "docs/results/calibration.csv"
STUDY = ("domain", "human_model", "engine", "people")
"""Columns that say what was calibrated."""
PERCENT = [round(100 * level) for level in LEVELS]
LABELS = {"search_rescue": "search and rescue", "bomb_defusal": "bomb defusal"}


def new_rows(calibration: Calibration, engine: str) -> list[dict[str, str]]:
    """Return the rows of a calibration."""
    about, names = calibration.data.attrs, {kind.__name__: name for name, kind in VARIANTS.items()}
    study = {
        "domain": about["domain"],
        "human_model": names.get(about["human_model"], about["human_model"]),
        "engine": engine,
        "people": str(calibration.people),
    }
    return [
        study
        | {
            "implant": row["site"].replace("_", " "),
            "rounds": str(row["rounds"]),
            "p": f"{row['p_value']:.5f}",
            **{f"within_{q}": f"{100 * row[f'coverage_{q}']:.1f}" for q in PERCENT},
            "contraction": _number(row["contraction"], 2),
            "unreliable_weights": _number(100 * row["high_pareto_k"], 0),
        }
        for row in calibration.table().to_dict("records")
    ]


def added(rows: Sequence[dict[str, str]], new: Sequence[dict[str, str]]) -> list[dict[str, str]]:
    """Return rows with new ones in place of those of the same world, human model and engine."""
    done = {_study(row)[:3] for row in new}
    return [*(row for row in rows if _study(row)[:3] not in done), *new]


def table(rows: Iterable[dict[str, str]]) -> str:
    """Return the table of the page."""
    lines = [
        "| World, human model, engine, people; after 1, 5 and 20 rounds | rejected | least *p* | "
        "50% | 80% | 90% (coverage, mean) | 90%, range over implants and rounds |",
        "|---|---|---|---|---|---|---|",
    ]
    for (domain, human, engine, people), group in itertools.groupby(rows, _study):
        own = list(group)
        rejected: dict[str, int] = {}
        for row in own:
            if float(row["p"]) <= FAILURE_RATE:
                rejected[row["implant"]] = rejected.get(row["implant"], 0) + 1
        which = ", ".join(f"`{name.replace(' ', '_')}`, {n}" for name, n in rejected.items())
        least = f"{min(float(row['p']) for row in own):.3f}".lstrip("0")
        within = {q: [float(row[f"within_{q}"]) for row in own] for q in PERCENT}
        means = " | ".join(f"{sum(each) / len(each):.1f}" for each in within.values())
        lines.append(
            f"| {LABELS.get(domain, domain)}, `{human}`, `{engine}`, {people} | "
            f"{which or 'none'} of {len(own)} | {least} | {means} | "
            f"{min(within[90]):.0f} to {max(within[90]):.0f} |"
        )
    return "\n".join(lines)


def _number(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def _study(row: dict[str, str]) -> tuple[str, ...]:
    return tuple(row[name] for name in STUDY)


def main() -> None:
    """Add the rows of a calibration, if one is given, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", nargs="?", type=Path, help="calibration.nc of `calibrate`")
    parser.add_argument("--engine", default="importance", help="engine that was calibrated")
    given = parser.parse_args()
    rows = rows_in(ROWS)
    if given.file is not None:
        new = new_rows(Calibration.load(given.file), given.engine)
        rows = rows_in(ROWS, added(rows, new))
    print(table(rows))


if __name__ == "__main__":
    main()

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
from mirror_ppl.domains import get_domain
from mirror_ppl.inference.calibration.ranks import FAILURE_RATE, LEVELS, Calibration
from mirror_ppl.models.loading import model_name

ROWS = Path(__file__).parents[1] / "docs/results/calibration.csv"
STUDY = ("domain", "human_model", "engine")
"""Columns that say what was calibrated, in the setting in which people see less."""
ROUNDS = [1, 5, 20]
PERCENT = [round(100 * level) for level in LEVELS]
LABELS = {"search_rescue": "search and rescue", "bomb_defusal": "bomb defusal"}


def new_rows(calibration: Calibration) -> list[dict[str, str]]:
    """Return the rows of a calibration.

    Raises:
        SystemExit: it is of other numbers of rounds or of another setting than the table, or does
            not name its engine.
    """
    about, rounds = calibration.data.attrs, calibration.data["rounds"].values.tolist()
    usual = get_domain(about["domain"]).settings[-1]
    if rounds != ROUNDS or about["setting"] != usual:
        raise SystemExit(
            f"the table is of {ROUNDS} rounds in {usual}, not of {rounds} in {about['setting']}"
        )
    if "engine" not in about:
        raise SystemExit("this calibration does not name its engine; calibrate again")
    study = {
        "domain": about["domain"],
        "human_model": model_name(about["human_model"]),
        "engine": about["engine"],
        "people": str(calibration.people),
    }
    return [
        study
        | {
            "implant": row["site"].replace("_", " "),
            "rounds": str(row["rounds"]),
            "p": f"{row['p_value']:.3g}",
            "rejected": str(int(row["p_value"] < FAILURE_RATE)),
            **{f"within_{q}": f"{100 * row[f'coverage_{q}']:.1f}" for q in PERCENT},
            "contraction": _number(row["contraction"], 2),
            "unreliable_weights": _number(100 * row["high_pareto_k"], 0),
        }
        for row in calibration.table().to_dict("records")
    ]


def replaced(rows: Sequence[dict[str, str]], new: Sequence[dict[str, str]]) -> list[dict[str, str]]:
    """Return rows with new ones in place of those of the same study, or as their world's last."""
    studies = {key: list(own) for key, own in itertools.groupby(rows, _study)}
    studies[_study(new[0])] = list(new)
    worlds = list(dict.fromkeys(world for world, *_ in studies))
    order = sorted(studies, key=lambda study: worlds.index(study[0]))
    return [row for study in order for row in studies[study]]


def table(rows: Iterable[dict[str, str]]) -> str:
    """Return the table of the page."""
    lines = [
        "| World, human model, engine, people; after 1, 5 and 20 rounds | rejected | least *p* | "
        "50% | 80% | 90% (coverage, mean) | 90%, range over implants and rounds |",
        "|---|---|---|---|---|---|---|",
    ]
    for (domain, human, engine), group in itertools.groupby(rows, _study):
        own = list(group)
        rejected: dict[str, int] = {}
        for row in own:
            if row["rejected"] == "1":
                rejected[row["implant"]] = rejected.get(row["implant"], 0) + 1
        which = ", ".join(f"`{name.replace(' ', '_')}`, {n}" for name, n in rejected.items())
        least = min(float(row["p"]) for row in own)
        shown = "<.001" if least < 0.001 else f"{least:.3f}".lstrip("0")
        within = {q: [float(row[f"within_{q}"]) for row in own] for q in PERCENT}
        means = " | ".join(f"{sum(each) / len(each):.1f}" for each in within.values())
        lines.append(
            f"| {LABELS.get(domain, domain)}, `{human}`, `{engine}`, {own[0]['people']} | "
            f"{which or 'none'} of {len(own)} | {shown} | {means} | "
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
    given = parser.parse_args()
    rows = rows_in(ROWS)
    if given.file is not None:
        rows = rows_in(ROWS, replaced(rows, new_rows(Calibration.load(given.file))))
    print(table(rows))


if __name__ == "__main__":
    main()

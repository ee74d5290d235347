r"""What is inferred of people among rolling balls, and what messages are worth to them.

    python -m mirror_ppl.train --domain docs/examples/obstacles.py:Obstacles
    python -m mirror_ppl.simulate --domain docs/examples/obstacles.py:Obstacles \
        --population diverse --out runs/balls.nc
    python -m mirror_ppl.fit --domain docs/examples/obstacles.py:Obstacles --demos runs/balls.nc \
        --train-rounds 20 --explore 0 --out runs/balls
    python -m mirror_ppl.assist --domain docs/examples/obstacles.py:Obstacles \
        --posterior runs/balls/posterior.nc --rounds 5 \
        --communicator none nearest all mirror oracle --json runs/balls.json
    python -m benchmarks.example_world runs/balls/summary.json runs/balls.json

The last command writes docs/results/obstacles_implants.csv and obstacles_messages.csv. Without
files it prints what the rows that are there say: the table of docs/adding_a_world.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from benchmarks._assist_rows import rows_of
from benchmarks._rows import rows_in

RESULTS = Path(__file__).parents[1] / "docs/results"
IMPLANTS, MESSAGES = RESULTS / "obstacles_implants.csv", RESULTS / "obstacles_messages.csv"


def implants_of(path: Path) -> list[dict[str, str]]:
    """Return a row for each person and implant of known truth in the summary of a fit."""
    return [
        {"person": person["id"], "implant": name}
        | {key: f"{float(own[key]):.4f}" for key in ("truth", "median", "q05", "q95")}
        for person in json.loads(path.read_text())["people"]
        for name, own in person["implants"].items()
        if own["truth"] is not None
    ]


def held(rows: Sequence[dict[str, str]]) -> dict[str, int]:
    """Return by implant the number of people whose 90% interval holds the truth."""
    numbers: dict[str, int] = {}
    for row in rows:
        low, truth, high = (float(row[key]) for key in ("q05", "truth", "q95"))
        numbers[row["implant"]] = numbers.get(row["implant"], 0) + (low <= truth <= high)
    return numbers


def table(rows: Sequence[dict[str, str]]) -> str:
    """Return the table of the page."""
    lines = [
        "| Communicator | Net return a round | Above silence, 90% interval | "
        "% of the way from silence to `oracle` |",
        "|---|---|---|---|",
    ]
    for row in rows:
        gain, way = "", "0"
        if row["communicator"] != "none":
            parts = [float(row[f"over_none_{part}"]) for part in ("mean", "low", "high")]
            gain = "{:.2f} [{:.2f}, {:.2f}]".format(*parts)
            ways = [100 * float(row[f"way_to_oracle_{part}"]) for part in ("mean", "low", "high")]
            way = "{:.0f} [{:.0f}, {:.0f}]".format(*ways)
        if row["communicator"] == "oracle":
            way = "100"
        lines.append(f"| {row['communicator']} | {float(row['net']):.2f} | {gain} | {way} |")
    return "\n".join(lines)


def main() -> None:
    """Write the rows of a fit and of assistance, if given, and print what they say."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", type=Path, help="summary.json, and what --json wrote")
    given = parser.parse_args().files
    implants, messages = (implants_of(given[0]), rows_of(given[1])) if given else ((), ())
    print(held(rows_in(IMPLANTS, implants)))
    print(table(rows_in(MESSAGES, messages)))


if __name__ == "__main__":
    main()

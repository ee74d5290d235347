r"""What messages are worth to highway drivers: the table of docs/highway.md.

    python -m mirror_ppl.fit --domain highway --setting fog --population diverse \
        --train-rounds 20 --explore 0 --out runs/highway_0
    python -m mirror_ppl.assist --posterior runs/highway_0/posterior.nc --rounds 8 \
        --communicator none all nearest mirror oracle --json runs/highway_assist.json
    python -m benchmarks.highway_messages runs/highway_assist.json

The last command writes a row for each communicator to docs/results/highway_messages.csv. Without a
file it prints the table of the rows that are there.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks._assist_rows import rows_of
from benchmarks._rows import rows_in

ROWS = Path(__file__).parents[1] / "docs/results/highway_messages.csv"
NAMES = {"none": "silence", "all": "everything", "nearest": "nearest hidden car"}
"""Names of communicators in the table, where they are words."""


def table(rows: Sequence[dict[str, str]]) -> str:
    """Return the table of the page."""
    lines = [
        "| Communicator | Net return a round | Above silence | % of the way to the oracle | "
        "Rounds with an accident | Groups shown, sentences said a decision |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        name, own = row["communicator"], {k: v for k, v in row.items() if k != "communicator"}
        number = {key: float(value) for key, value in own.items() if value}
        label = NAMES.get(name, "oracle" if name == "oracle" else f"`{name}`")
        accidents = round(number["mishaps"] * number["people"] * number["rounds"])
        ways = ("way_to_oracle_mean", "way_to_oracle_low", "way_to_oracle_high")
        way = "{:.0f} [{:.0f}, {:.0f}]".format(*(100 * number[key] for key in ways))
        gain = "{:.1f} [{:.1f}, {:.1f}]".format(
            *(number[f"over_none_{part}"] for part in ("mean", "low", "high"))
        )
        none = name == "none"
        lines.append(
            f"| {label} | {number['net']:.1f} ± {number['net_se']:.1f} | {'' if none else gain} | "
            f"{'' if none or name == 'oracle' else way} | "
            f"{accidents} of {number['people'] * number['rounds']:.0f} | "
            f"{number['visual']:.2f}, {number['verbal']:.2f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Write the rows of a run, if one is given, and print their table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", nargs="?", type=Path, help="what `assist --json` wrote")
    given = parser.parse_args().file
    print(table(rows_in(ROWS, rows_of(given) if given else ())))


if __name__ == "__main__":
    main()

r"""What messages are worth to highway drivers: the tables of docs/highway.md.

    python -m mirror_ppl.evaluate assistance --domain highway --setting fog --population diverse \
        --people 10 --seeds 1 --rounds 0 20 --played 8 \
        --models mirror bc sqil none all nearest oracle --out runs/fog
    python -m mirror_ppl.evaluate assistance --domain highway --setting clear \
        --population diverse --people 10 --seeds 1 --rounds 20 --played 8 \
        --models mirror none all nearest oracle --out runs/clear
    python -m benchmarks.highway_messages runs/fog/assistance.csv runs/clear/assistance.csv

The last command writes the rows of these studies to docs/results/highway_assistance.csv. Without
files it prints the tables of the rows that are there.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._rows import rows_in
from benchmarks.tables import rows_of
from mirror_ppl.evaluation.assistance import REFERENCES
from mirror_ppl.evaluation.study_summary import (
    FIRST,
    NONE,
    ORACLE,
    interval,
    summarize_study,
    ways_to_oracle,
)
from mirror_ppl.evaluation.tables import Rows

ROWS = Path(__file__).parents[1] / "docs/results/highway_assistance.csv"
PLAYED = 8
"""Rounds of each driver, as in the commands above."""
NAMES = {NONE: "silence", "all": "everything", "nearest": "nearest hidden car", ORACLE: "oracle"}
"""Names of communicators in the table, where they are words."""


def by_driver(rows: Iterable[dict[str, Any]]) -> Rows:
    """Return the rows in the order of drivers, so that those of two communicators pair."""
    return sorted(rows, key=lambda row: (row["seed"], row["person"]))


def table(rows: Rows, setting: str) -> str:
    """Return the table of a setting, by net return."""
    here = by_driver(row for row in rows if row["setting"] == setting)
    ways = {(way.model, way.rounds): way.share for way in ways_to_oracle(here)}
    lines = []
    for (name, rounds), way in ways.items():
        own, silent = (
            [row for row in here if (row["model"], row["rounds"]) == key]
            for key in ((name, rounds), (NONE, 0))
        )
        net, cost = (np.array([row[key] for row in own]) for key in ("net", "cost"))
        above = interval(net - np.array([row["net"] for row in silent]))
        gain = f"{above.mean:.1f} [{above.low:.1f}, {above.high:.1f}]"
        share = ""
        if way is not None and name not in (NONE, ORACLE):
            share = f"{100 * way.mean:.0f} [{100 * way.low:.0f}, {100 * way.high:.0f}]"
        played = PLAYED * len(own)
        accidents = round(sum(row["mishaps"] for row in own) * PLAYED)
        shown, said = (sum(row[f"items_{m}"] for row in own) / played for m in ("visual", "verbal"))
        cells = [
            NAMES.get(name, f"`{name}`"),
            "" if name in REFERENCES else f"{rounds}",
            f"{net.mean():.1f} ± {net.std(ddof=1) / len(net) ** 0.5:.1f}",
            "" if name == NONE else gain,
            share,
            f"{accidents} of {played}",
            f"{shown:.1f}, {said:.1f}",
            f"{cost.mean():.1f}",
        ]
        lines.append((net.mean(), f"| {' | '.join(cells)} |"))
    heads = (
        "| Communicator | Rounds learned from | Net return a round | Above silence | "
        "% of the way to the oracle | Rounds with an accident | "
        "Groups shown, sentences said a round | Cost a round |"
    )
    return "\n".join([heads, "|---" * 8 + "|", *(line for _, line in sorted(lines))])


def advantages(rows: Rows) -> str:
    """Return the table of how far ``mirror`` is ahead, with as many rounds or with the most."""
    found = {
        (one.model, one.rounds, one.place.setting): one.mirror.ahead
        for one in summarize_study(rows, "net")
        if one.mirror is not None and one.model != ORACLE
    }
    settings = list(dict.fromkeys(setting for _, _, setting in found))
    lines = []
    for name, rounds in dict.fromkeys(key[:2] for key in found):
        ahead = (found.get((name, rounds, setting)) for setting in settings)
        cells = ["" if x is None else f"{x.mean:.1f} [{x.low:.1f}, {x.high:.1f}]" for x in ahead]
        learned = "" if name in REFERENCES else f", {rounds or 'no'} rounds"
        lines.append(f"| {NAMES.get(name, f'`{name}`')}{learned} | {' | '.join(cells)} |")
    heads = f"| `{FIRST}` ahead of | {' | '.join(settings)} |"
    return "\n".join([heads, "|---" * (1 + len(settings)) + "|", *lines])


def main() -> None:
    """Write the rows of studies, if some are given, and print their tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", type=Path, help="rows that `evaluate` wrote")
    rows_in(ROWS, [row for path in parser.parse_args().files for row in rows_in(path)])
    rows = rows_of(ROWS)
    for setting in dict.fromkeys(row["setting"] for row in rows):
        print(f"{setting}\n{table(rows, setting)}\n")
    print(advantages(rows))


if __name__ == "__main__":
    main()

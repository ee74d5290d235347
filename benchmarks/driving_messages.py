r"""What messages are worth to drivers in each setting and population: for docs/communicator.md.

    python -m mirror_ppl.fit --domain driving --setting fog --population paper \
        --train-rounds 20 --explore 0 --out runs/fog_paper
    python -m mirror_ppl.assist --posterior runs/fog_paper/posterior.nc --rounds 50 \
        --communicator none all random nearest oracle mirror mirror-self-model mirror-kl \
        --json runs/fog_paper.json

and so for the other settings and populations, with ``none nearest oracle mirror``. Then::

    python -m benchmarks.driving_messages runs/fog_paper.json runs/fog_diverse.json \
        runs/clear_paper.json runs/clear_diverse.json

This writes a row for each communicator to docs/results/driving_messages.csv. Without files it
prints the tables of the rows that are there.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks._assist_rows import rows_of
from benchmarks._rows import rows_in
from mirror_ppl.evaluation.study_summary import interval as people_interval

ROWS = Path(__file__).parents[1] / "docs/results/driving_messages.csv"
Rows = Sequence[dict[str, str]]
ORDER = ("mirror", "mirror-self-model", "mirror-kl", "none", "all", "random", "nearest", "oracle")
"""Communicators, as the page has them."""
ELSEWHERE = (("clear", "paper"), ("clear", "diverse"), ("fog", "diverse"))
"""Settings and populations of the short table."""


def of(rows: Rows, setting: str, population: str) -> dict[str, dict[str, str]]:
    """Return the rows of a setting and population, by communicator."""
    return {
        row["communicator"]: row
        for row in rows
        if (row["setting"], row["population"]) == (setting, population)
    }


def interval(row: dict[str, str], key: str, form: str, scale: float = 1.0, unit: str = "") -> str:
    """Return a mean with its interval."""
    mean, low, high = (scale * float(row[f"{key}_{part}"]) for part in ("mean", "low", "high"))
    return f"{mean:{form}}{unit} [{low:{form}}, {high:{form}}]"


def fog_table(rows: Rows) -> str:
    """Return the table of all communicators for people of ``paper`` in fog."""
    own = of(rows, "fog", "paper")
    lines = [
        "| Fog, `paper` | task | cost | net | above `none` | way to `oracle` | collisions "
        "| items shown, said per step | on collision course, closing |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in ORDER:
        row, silent = own[name], name == "none"
        number = {key: float(row[key]) for key in ("task", "cost", "net", "mishaps")}
        way = {"none": "0%", "oracle": "100%"}.get(name)
        sent = (f"{float(row[modality]):.2f}" for modality in ("visual", "verbal"))
        items = ", ".join(number.removeprefix("0") for number in sent)
        about = ", ".join(f"{float(row[key] or 0):.0%}" for key in ("collision_course", "closing"))
        lines.append(
            f"| `{name}` | {number['task']:.2f} | {number['cost']:.2f} | {number['net']:.2f} | "
            f"{'' if silent else interval(row, 'over_none', '+.2f')} | "
            f"{way or interval(row, 'way_to_oracle', '.0f', 100, '%')} | {number['mishaps']:.2f} | "
            f"{'' if silent else items} | {'' if silent else about} |"
        )
    return "\n".join(lines)


def short_table(rows: Rows) -> str:
    """Return the table of other settings and populations."""
    names = "mirror", "none", "nearest", "oracle"
    lines = [
        f"| Net return elsewhere | {' | '.join(f'`{name}`' for name in names)} "
        "| `mirror` above `none` | way to `oracle` |",
        "|---|---|---|---|---|---|---|",
    ]
    for setting, population in ELSEWHERE:
        own = of(rows, setting, population)
        net = " | ".join(f"{float(own[name]['net']):.2f}" for name in names)
        lines.append(
            f"| {setting}, `{population}` | {net} | "
            f"{interval(own['mirror'], 'over_none', '+.2f')} | "
            f"{interval(own['mirror'], 'way_to_oracle', '.0f', 100, '%')} |"
        )
    return "\n".join(lines)


def net_of_people(row: dict[str, str]) -> np.ndarray:
    """Return the mean net return of each person ``[P]``."""
    return np.array(row["net_by_person"].split(), dtype=float)


def above_nearest(rows: Rows) -> str:
    """Return what ``mirror`` gains above ``nearest`` in fog, with the interval over people."""
    own = of(rows, "fog", "paper")
    gain = people_interval(net_of_people(own["mirror"]) - net_of_people(own["nearest"]))
    return f"{gain.mean:.2f} [{gain.low:.2f}, {gain.high:.2f}]".replace("0.", ".")


def main() -> None:
    """Write the rows of runs, if they are given, and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", type=Path, help="what `assist --json` wrote")
    given = parser.parse_args().files
    rows = rows_in(ROWS, [row for file in given for row in rows_of(file, with_people=True)])
    print(fog_table(rows), short_table(rows), sep="\n\n")
    print(f"\nmirror above nearest in fog: {above_nearest(rows)}")


if __name__ == "__main__":
    main()

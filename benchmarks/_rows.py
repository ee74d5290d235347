"""Rows of a result: written if there are new ones, and read."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path


def rows_in(path: Path, new: Sequence[dict[str, str]] = ()) -> list[dict[str, str]]:
    """Return the rows of a CSV file, which new ones replace if there are any."""
    if new:
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, new[0])
            writer.writeheader()
            writer.writerows(new)
    with path.open(newline="") as file:
        return list(csv.DictReader(file))

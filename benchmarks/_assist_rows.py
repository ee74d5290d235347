"""Rows of runs of `assist`, one for each communicator."""

from __future__ import annotations

import json
from pathlib import Path


def rows_of(path: Path, with_people: bool = False) -> list[dict[str, str]]:
    """Return the rows of one run, by net return.

    Args:
        path: what ``assist --json`` wrote.
        with_people: whether to add setting, population, what items were about, and the net return
            of each person.
    """
    results = json.loads(path.read_text())
    recorded = results["posterior"]
    rows = []
    for name, own in results["communicators"].items():
        row = {
            "communicator": name,
            "people": len(own["net_by_person"]),
            "rounds": results["options"]["rounds"],
            **{key: own[key] for key in ("task", "cost", "net", "net_se", "mishaps")},
            **own["items"],
        }
        for key in ("over_none", "way_to_oracle"):
            found = own.get(key) or dict.fromkeys(("mean", "low", "high"), "")
            row |= {f"{key}_{part}": found[part] for part in ("mean", "low", "high")}
        if with_people:
            where = {"setting": recorded["setting"], "population": recorded["recorded_population"]}
            net = " ".join(f"{value:.4f}" for value in own["net_by_person"])
            relevant = {name: share["all"] for name, share in own["relevant"].items()}
            row = where | row | relevant | {"net_by_person": net}
        rows.append(row)
    rows.sort(key=lambda row: row["net"])
    return [
        {
            key: "" if x is None else f"{x:.6f}" if isinstance(x, float) else str(x)
            for key, x in row.items()
        }
        for row in rows
    ]

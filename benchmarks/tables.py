"""Every number of docs/results.md that is of a study, from the rows that are kept of it.

    python -m benchmarks.tables

Reads ``docs/results/<world>_prediction.csv`` and ``..._assistance.csv``, rows that `python -m
mirror_ppl.evaluate` wrote, and writes the page and the picture of each (and of relevance, which is
in the rows of assistance), and the tables in docs/results.md between the lines
``<!-- <world> <study> -->`` and ``<!-- end -->``. The same rows give the same pages.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path

from mirror_ppl.evaluation.assistance import REFERENCES
from mirror_ppl.evaluation.study_report import REPORTS, difference
from mirror_ppl.evaluation.study_summary import (
    POOLED,
    POOLING,
    ModelResult,
    Place,
    floors,
    summarize_study,
    ways_to_oracle,
)
from mirror_ppl.evaluation.tables import Rows, page

DOCS = Path(__file__).parents[1] / "docs"
RESULTS = DOCS / "results"
WORDS, WHOLE = ("domain", "setting", "population", "person", "model"), ("seed", "rounds")
"""Columns that are no numbers, and that are whole ones."""
BLOCK = re.compile(r"<!-- (\w+) (\w+) -->\n.*?<!-- end -->", re.DOTALL)


def rows_of(path: Path) -> Rows:
    """Rows of a study; what a row lacks is left out, but for people's entropy, which is unknown."""
    with path.open(newline="") as file:
        return [
            {name: _value(name, text) for name, text in row.items() if text or name == "floor"}
            for row in csv.DictReader(file)
        ]


def _value(name: str, text: str) -> str | int | float | None:
    if name in WORDS:
        return text
    if name in WHOLE or name.startswith("items_"):
        return int(text)
    return float(text) if text else None


def studies() -> dict[str, Rows]:
    """Rows of each study that is kept, by the name of its page."""
    found = {}
    for path in sorted(RESULTS.glob("*_prediction.csv")):
        found[path.stem] = rows_of(path)
    for path in sorted(RESULTS.glob("*_assistance.csv")):
        rows = found[path.stem] = rows_of(path)
        most = max(row["rounds"] for row in rows)
        last = [row for row in rows if row["rounds"] == most or row["model"] in REFERENCES]
        found[path.stem.replace("assistance", "relevance")] = last
    return found


def study_page(name: str, rows: Rows) -> str:
    """The page of a study, from its rows."""
    world, _, study = name.rpartition("_")
    kept = name.replace("relevance", "assistance")
    report = REPORTS[study](rows)
    return (
        f"# {world.replace('_', ' ').capitalize()}: {study}\n\n"
        f"Made by `make tables` from [its rows]({kept}.csv); what it means stands on [the page of "
        f"results](../results.md).\n\n{page(report.sentences, report.tables)}"
    )


def results_page(text: str) -> str:
    """docs/results.md with the tables of all studies whose rows are kept."""
    kept = studies()

    def block(found: re.Match[str]) -> str:
        world, study = found.groups()
        return f"<!-- {world} {study} -->\n{TABLES[study](kept[f'{world}_{study}'])}\n<!-- end -->"

    return BLOCK.sub(block, text)


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ("---", *("---:" for _ in heads[1:])), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _prediction(rows: Rows) -> str:
    """Held-out NLL of each place, and by how much MIRROR is ahead."""
    results, parts = summarize_study(rows, "nll", -1), []
    floor = floors(rows)
    for place in dict.fromkeys(one.place for one in results):
        here = [one for one in results if one.place == place]
        numbers = sorted({one.rounds for one in here})
        by = {(one.model, one.rounds): one for one in here}
        names = list(dict.fromkeys(one.model for one in here))
        entropy = f", people's own entropy: {floor[place]:.3f}" if place in floor else ""
        heads = (f"NLL, {_where(place)} (nats{entropy})", *_rounds(numbers))
        parts.append(
            _table(
                heads,
                [
                    (f"`{name}`", *(f"{by[name, n].measured.mean:.3f}" for n in numbers))
                    for name in names
                ],
            )
        )
        heads = (f"`mirror` ahead by, {_where(place)} (nats)", *_rounds(numbers))
        others = [name for name in names if by[name, numbers[0]].mirror and name != POOLED]
        parts.append(
            _table(
                heads,
                [
                    (_against(name, POOLED in names), *(_ahead(by[name, n], 3) for n in numbers))
                    for name in others
                ],
            )
        )
    return "\n\n".join(parts)


def _assistance(rows: Rows) -> str:
    """Way to the oracle of each place, and what learning about the person gained."""
    ways, parts = ways_to_oracle(rows), []
    for place in dict.fromkeys(one.place for one in ways):
        here = [one for one in ways if one.place == place]
        numbers = sorted({one.rounds for one in here})
        by = {(one.model, one.rounds): one for one in here}
        lines = []
        for name in dict.fromkeys(one.model for one in here):
            cells = []
            for number in numbers:
                one = by.get((name, number))
                share = None if one is None else one.share
                cells.append(
                    ""
                    if share is None
                    else f"{100 * share.mean:.0f}% [{100 * share.low:.0f}, {100 * share.high:.0f}]"
                )
            most = by.get((name, numbers[-1]))
            gained = None if most is None else most.learned
            lines.append(
                (f"`{name}`", *cells, "" if gained is None else _line(difference(gained, 2)))
            )
        heads = (f"way to the oracle, {_where(place)}", *_rounds(numbers))
        parts.append(_table((*heads, "gained by learning"), lines))
    return "\n\n".join(parts)


def _where(place: Place) -> str:
    return f"{place.setting}, {place.population}"


def _rounds(numbers: Sequence[int]) -> list[str]:
    return [f"{number or 'no'} round{'' if number == 1 else 's'}" for number in numbers]


def _against(name: str, pooled: bool) -> str:
    return f"`{name}` (of `{POOLED}`)" if name in POOLING and pooled else f"`{name}`"


def _ahead(one: ModelResult, digits: int) -> str:
    return "" if one.mirror is None else _line(difference(one.mirror.ahead, digits))


def _line(text: str) -> str:
    return text.replace("\n", " ")


TABLES = {"prediction": _prediction, "assistance": _assistance}
"""What stands in docs/results.md, by study."""


def main() -> None:
    """Write all of them."""
    for name, rows in studies().items():
        path = RESULTS / f"{name}.md"
        path.write_text(study_page(name, rows))
        picture = REPORTS[name.rpartition("_")[2]](rows).picture
        path.with_suffix(".png").write_bytes(picture.content())
        print(path)
    own = DOCS / "results.md"
    own.write_text(results_page(own.read_text()))
    print(own)


if __name__ == "__main__":
    main()

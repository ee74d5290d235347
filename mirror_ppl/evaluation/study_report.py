"""What a study says: tables to read, data to keep, and a picture."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mirror_ppl.domains import Domain, Observation, get_domain
from mirror_ppl.evaluation.study_summary import (
    Interval,
    Place,
    Share,
    Standing,
    few_against_many,
    floors,
    relevance,
    summarize_study,
)
from mirror_ppl.evaluation.sweep import Rows
from mirror_ppl.plots.picture import Picture
from mirror_ppl.plots.study import plot_curves, plot_relevance

WIDTH = 110


def write_table(path: Path, rows: Rows) -> None:
    """As comma-separated values; columns that a row lacks stay empty."""
    columns = dict.fromkeys(name for row in rows for name in row)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(columns))
        writer.writeheader()
        writer.writerows(rows)


def _prediction(rows: Rows) -> tuple[dict[str, Any], Picture]:
    standings, floor = summarize_study(rows, "nll", -1), floors(rows)
    claims = few_against_many(rows, "nll", -1)
    _show(standings, "NLL of held-out actions, nats an action: less is better", floor)
    for claim in claims:
        ahead, better = claim.paired.ahead, claim.paired.improvement
        print(
            f"{claim.place.domain}, {claim.place.setting}: mirror with {_counted(claim.rounds)} "
            f"against {claim.rival} with {_counted(claim.rival_rounds)}: ahead by {_text(ahead)} "
            f"nats an action, in {100 * better.mean:.0f}% of people"
        )
    data = {
        "nll": standings,
        "accuracy": summarize_study(rows, "accuracy"),
        "few_against_many": claims,
    }
    return data, plot_curves(standings, "NLL of held-out actions (nats an action)", floor)


def _assistance(rows: Rows) -> tuple[dict[str, Any], Picture]:
    standings = summarize_study(rows, "net")
    _show(standings, "net return of a round: more is better", {})
    return {"net": standings}, plot_curves(standings, "net return of a round")


def _relevance(rows: Rows) -> tuple[dict[str, Any], Picture]:
    first, data = [], {}
    for name in dict.fromkeys(row["domain"] for row in rows):
        domain, own = get_domain(name), [row for row in rows if row["domain"] == name]
        for place, notion in enumerate(domain.relevance(_first_observation(domain))):
            found = relevance(own, notion, [m.name for m in domain.modalities])
            data[f"{name}: {notion}"] = found
            for where in dict.fromkeys(one.place for one in found):
                here = [one for one in found if one.place == where]
                if not place:
                    first.append(here)
                _show_shares(here, f"{', '.join(where)}: items about {notion.replace('_', ' ')}")
    return {"relevance": data}, plot_relevance(first)


def _first_observation(domain: Domain) -> Observation:
    return domain.observe(domain.initial(1, torch.Generator().manual_seed(0)))


def _show(standings: Sequence[Standing], title: str, floor: Mapping[Place, float]) -> None:
    for place in dict.fromkeys(one.place for one in standings):
        here = [one for one in standings if one.place == place]
        numbers = sorted({one.rounds for one in here})
        by = {(one.model, one.rounds): one for one in here}
        number = max(one.people for one in here)
        caption = f"mean over people ({number}), by rounds learned from"
        if any(one.mirror for one in here):
            caption += (
                "; below it how far mirror is ahead with as many (of who learns nothing: with "
            )
            caption += "the most), the 90% interval of that over people, and in how many of them"
        if place in floor:
            caption += f"; people's own entropy: {floor[place]:.3f}"
        rows = [
            [model, *(_entry(by.get((model, number))) for number in numbers)]
            for model in dict.fromkeys(one.model for one in here)
        ]
        heads = ["model", *("-" if number == 0 else _counted(number) for number in numbers)]
        _print(f"{', '.join(place)}: {title}", caption, heads, rows)


def _entry(one: Standing | None) -> str:
    if one is None:
        return ""
    text = f"{one.measured.mean:.3f}"
    if one.mirror is None:
        return text
    ahead, better = one.mirror.ahead, one.mirror.improvement
    digits = 2 if max(abs(ahead.low), abs(ahead.high)) >= 1 else 3
    low, high = (f"{value:+.{digits}f}" for value in (ahead.low, ahead.high))
    return f"{text}\n{ahead.mean:+.{digits}f}\n[{low}, {high}]\n{100 * better.mean:.0f}%"


def _show_shares(shares: Sequence[Share], title: str) -> None:
    names = list(dict.fromkeys(one.modality for one in shares))
    cells: dict[tuple[str, int], dict[str, str]] = {}
    for one in shares:
        text = "nothing told"
        if one.share is not None:
            low, high = 100 * one.share.low, 100 * one.share.high
            text = f"{100 * one.share.mean:.0f}% [{low:.0f}, {high:.0f}] of {one.items}"
        cells.setdefault((one.model, one.rounds), {})[one.modality] = text
    rows = [
        [model, "-" if rounds == 0 else str(rounds), *(own[name] for name in names)]
        for (model, rounds), own in cells.items()
    ]
    caption = "share that is relevant [90% interval over people] of the items told"
    _print(title, caption, ["model", "rounds", *names], rows)


def _text(one: Interval) -> str:
    return f"{one.mean:+.3f} [{one.low:+.3f}, {one.high:+.3f}]"


def _counted(number: int) -> str:
    return f"{number} round" + ("s" if number > 1 else "")


def _print(title: str, caption: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for place, head in enumerate(heads):
        table.add_column(head, justify="right" if place else "left")
    for row in rows:
        table.add_row(*map(Text, row))
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    # Not by the table, which would make them as narrow as it is.
    console.print(title, style="italic", highlight=False)
    console.print(table, end="")
    console.print(f"({caption})\n", style="dim", highlight=False)


REPORTS: dict[str, Callable[[Rows], tuple[dict[str, Any], Picture]]] = {
    "prediction": _prediction,
    "assistance": _assistance,
    "relevance": _relevance,
}
"""By study: print tables of its rows; what is kept as data, and a picture."""

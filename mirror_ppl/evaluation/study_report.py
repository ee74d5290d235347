"""Reports of studies: tables, sentences, data and a picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from mirror_ppl.domains import Domain, Observation, get_domain
from mirror_ppl.evaluation.assistance import REFERENCES
from mirror_ppl.evaluation.study_summary import (
    POOLED,
    POOLING,
    Claim,
    Interval,
    ModelResult,
    Paired,
    Place,
    Share,
    Way,
    few_against_many,
    floors,
    means_table,
    relevance,
    shares_table,
    summarize_study,
    ways_to_oracle,
)
from mirror_ppl.evaluation.tables import Rows, TextTable
from mirror_ppl.plots.picture import Picture
from mirror_ppl.plots.study import plot_curves, plot_relevance

NOTIONS = {"closing": "cars that close in", "goal_and_obstacle": "victim and obstacle"}
"""Notions of relevance in words, where their name alone is unclear."""


@dataclass(frozen=True)
class Report:
    """Report of a study.

    Attributes:
        tables: to print.
        sentences: to print below the tables.
        data: all numbers of the tables and sentences, and more.
        picture: figure of the results.
    """

    tables: list[TextTable]
    sentences: list[str]
    data: dict[str, Any]
    picture: Picture

    def show(self) -> None:
        """Print tables and sentences."""
        for table in self.tables:
            table.show()
        for sentence in self.sentences:
            print(sentence)


def _prediction(rows: Rows) -> Report:
    results, floor = summarize_study(rows, "nll", -1), floors(rows)
    accuracy, claims = summarize_study(rows, "accuracy"), few_against_many(rows, "nll", -1)
    data = {"nll": results, "accuracy": accuracy, "few_against_many": claims}
    return Report(
        [
            *_tables(results, "NLL of held-out actions (nats per action; lower is better)", floor),
            *_tables(accuracy, "accuracy of held-out actions (higher is better)", {}),
        ],
        [_claimed(claim) for claim in claims],
        data,
        plot_curves(
            means_table(results), "NLL of held-out actions (nats an action)", floor, by_ratio=True
        ),
    )


def _assistance(rows: Rows) -> Report:
    results, ways = summarize_study(rows, "net"), ways_to_oracle(rows)
    return Report(
        [*_tables(results, "net return per round (higher is better)", {}), *_ways(ways)],
        [],
        {"net": results, "way_to_oracle": ways},
        plot_curves(means_table(results), "net return of a round"),
    )


def _relevance(rows: Rows) -> Report:
    tables, first, data = [], [], {}
    for name in dict.fromkeys(row["domain"] for row in rows):
        domain, own = get_domain(name), [row for row in rows if row["domain"] == name]
        for place, notion in enumerate(domain.relevance(_first_observation(domain))):
            found = relevance(own, notion, [m.name for m in domain.modalities])
            data[f"{name}: {notion}"] = found
            for where in dict.fromkeys(one.place for one in found):
                here = [one for one in found if one.place == where]
                if not place:
                    first += here
                about = NOTIONS.get(notion, notion.replace("_", " "))
                title = f"{', '.join(where)}: items about {about}"
                tables.append(_shares(here, title))
    return Report(tables, [], {"relevance": data}, plot_relevance(shares_table(first)))


def _first_observation(domain: Domain) -> Observation:
    return domain.observe(domain.initial(1, torch.Generator().manual_seed(0)))


def _claimed(claim: Claim) -> str:
    ahead, better = claim.paired.ahead, claim.paired.improvement
    return (
        f"{claim.place.domain}, {claim.place.setting}: mirror with {_counted(claim.rounds)} "
        f"against {claim.baseline} with {_counted(claim.baseline_rounds)}: advantage of mirror "
        f"{_text(ahead)} nats per action; mirror is better in {100 * better.mean:.0f}% of people"
    )


def _tables(
    results: Sequence[ModelResult], title: str, floor: Mapping[Place, float]
) -> list[TextTable]:
    """One table per place."""
    tables = []
    for place in dict.fromkeys(one.place for one in results):
        here = [one for one in results if one.place == place]
        numbers = sorted({one.rounds for one in here})
        by = {(one.model, one.rounds): one for one in here}
        number = max(one.people for one in here)
        names = dict.fromkeys(one.model for one in here)
        pooling = [name for name in names if name in POOLING and POOLED in names]
        caption = f"mean over {number} people, by number of training rounds"
        if any(one.mirror for one in here):
            caption += (
                "; below it the advantage of mirror, its 90% interval over people, and the share "
                "of people in whom mirror is better (ties count half); mirror has as many training "
                "rounds as the compared model, or the largest number if that model does not learn"
                + (f"; {', '.join(pooling)}: advantage of {POOLED}" if pooling else "")
            )
        if place in floor:
            caption += f"; entropy of people's own choices: {floor[place]:.3f} nats"
        rows = tuple(
            (model, *(_entry(by.get((model, rounds)), number) for rounds in numbers))
            for model in names
        )
        heads = ("model", *map(_counted, numbers))
        tables.append(TextTable(f"{', '.join(place)}: {title}", caption, heads, rows))
    return tables


def _entry(one: ModelResult | None, people: int) -> str:
    if one is None:
        return ""
    text = f"{one.measured.mean:.3f}"
    if one.people < people:  # Something failed, so the people differ from those of the others.
        text += f" ({one.people} of {people} people)"
    if one.mirror is None:
        return text
    ahead = one.mirror.ahead
    return f"{text}\n{_ahead(one.mirror, 2 if max(abs(ahead.low), abs(ahead.high)) >= 1 else 3)}"


def _ahead(mirror: Paired, digits: int) -> str:
    return f"{difference(mirror.ahead, digits)}\n{100 * mirror.improvement.mean:.0f}%"


def difference(ahead: Interval, digits: int) -> str:
    """Format an advantage, with its interval on the next line."""
    return f"{ahead.mean:+.{digits}f}\n{ahead.between(f'+.{digits}f')}"


def _ways(ways: Sequence[Way]) -> list[TextTable]:
    """One table per place."""
    tables = []
    for place in dict.fromkeys(one.place for one in ways):
        here = [one for one in ways if one.place == place]
        numbers = sorted({one.rounds for one in here})
        by = {(one.model, one.rounds): one for one in here}
        rows = tuple(
            (model, *(_way(by.get((model, rounds))) for rounds in numbers))
            for model in dict.fromkeys(one.model for one in here)
        )
        caption = (
            f"share of the way [90% interval over {max(one.people for one in here)} people], by "
            "number of training rounds; below it the net return gained over the model's prior"
        )
        title = f"{', '.join(place)}: way from silence to the oracle, in net return"
        tables.append(TextTable(title, caption, ("model", *map(_counted, numbers)), rows))
    return tables


def _way(one: Way | None) -> str:
    if one is None:
        return ""
    text = "-"
    if one.share is not None:
        text = f"{100 * one.share.mean:.0f}% {one.share.between('.0f', 100)}"
    return text if one.learned is None else f"{text}\n{difference(one.learned, 2)}"


def _shares(shares: Sequence[Share], title: str) -> TextTable:
    names = list(dict.fromkeys(one.modality for one in shares))
    cells: dict[tuple[str, int], dict[str, str]] = {}
    for one in shares:
        text = "no messages"
        if one.share is not None:
            text = f"{100 * one.share.mean:.0f}% {one.share.between('.0f', 100)} of {one.items}"
        if one.mirror is not None:
            text += f"\n{_ahead(one.mirror, 2)}"
        cells.setdefault((one.model, one.rounds), {})[one.modality] = text
    rows = tuple(
        (model, "-" if model in REFERENCES else str(rounds), *(own[name] for name in names))
        for (model, rounds), own in cells.items()
    )
    caption = "share of the communicated items that is relevant [90% interval over people]"
    if any(one.mirror for one in shares):
        caption += (
            "; below it, over people with messages from both, the mean difference of mirror's "
            "share (of 1), its 90% interval, and the share of people in whom mirror's is larger "
            "(ties count half)"
        )
    return TextTable(title, caption, ("model", "rounds", *names), rows)


def _text(one: Interval) -> str:
    return f"{one.mean:+.3f} {one.between('+.3f')}"


def _counted(number: int) -> str:
    return f"{number or 'no'} round" + ("" if number == 1 else "s")


REPORTS: dict[str, Callable[[Rows], Report]] = {
    "prediction": _prediction,
    "assistance": _assistance,
    "relevance": _relevance,
}
"""Makers of reports, by study."""

"""Tables of what communicators are worth to people, for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from mirror_ppl.console import console_for_tables
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.world import EVERYTHING

FAR_BELOW = -10
"""Shares of the way from silence to the oracle below which no number is printed."""


def print_assistance(
    summary: Mapping[str, Mapping[str, Any]],
    attributes: Mapping[str, str],
    people: int,
    rounds: int,
) -> None:
    """Print two tables: what communicators are worth, and what they communicate.

    Args:
        summary: by communicator, from `summarize_assistance`.
        attributes: of the posterior, with its ``domain`` and ``setting``.
        people: number of people.
        rounds: of each person.
    """

    def table(title: str, caption: str, columns: list[str]) -> Table:
        made = Table(
            title=title,
            caption=caption,
            title_justify="left",
            caption_justify="left",
            box=SIMPLE_HEAD,
            padding=(0, 1, 0, 0),
        )
        made.add_column("communicator")
        for column in columns:
            made.add_column(column, justify="right", no_wrap=True)
        return made

    first = next(iter(summary.values()))
    domain = get_domain(attributes["domain"])
    own = [name for name in first["relevant"] if name != EVERYTHING]
    notions = [name.split("_")[-1] for name in own]
    about = [f"about {name.replace('_', ' ')}" for name in own]
    shares = f"{', '.join(notions)}: share of items {', '.join(about)}; " if own else ""
    who = f"{people} {'people' if people > 1 else 'person'}"
    worth = table(
        f"{attributes['domain']}, {attributes['setting']}: {who}, {rounds} "
        f"round{'s' * (rounds > 1)} each",
        "rewards a round; ±: standard error; [90% interval], paired; -: needs the communicators "
        "none and oracle, and oracle ahead of none in every bootstrap sample",
        ["task", "cost", "net", "above none", "way to oracle"],
    )
    said = table(
        "What is communicated",
        f"{domain.mishap[1]} a round; {', '.join(first['items'])}: items a step; "
        f"{shares}ms a decision",
        [domain.mishap[1], *first["items"], *notions, "ms"],
    )
    for name, entry in summary.items():
        error = "" if entry["net_se"] is None else f" ±{entry['net_se']:.2f}"
        worth.add_row(
            name,
            f"{entry['task']:.2f}",
            f"{entry['cost']:.2f}",
            f"{entry['net']:.2f}{error}",
            _interval(entry.get("over_none"), 1, "+.2f"),
            _way(entry.get("way_to_oracle")),
        )
        said.add_row(
            name,
            f"{entry['mishaps']:.2f}",
            *(f"{value:.2f}" for value in entry["items"].values()),
            *(
                "-"
                if entry["relevant"][one]["all"] is None
                else f"{100 * entry['relevant'][one]['all']:.0f}%"
                for one in own
            ),
            f"{entry['milliseconds']:.1f}",
        )
    console = console_for_tables(100)
    console.print(worth)
    console.print(said)
    if rounds == 1:
        print("Of one round of each person there are no errors and intervals; --rounds gives more")


def _way(value: Mapping[str, float | None] | None) -> str:
    """How far the way to the oracle; a number that is far below says nothing more."""
    if value is not None and (value["mean"] or 0) < FAR_BELOW:
        return f"below {FAR_BELOW:.0%}"
    return _interval(value, 100, ".0f", "%")


def _interval(
    value: Mapping[str, float | None] | None, scale: float, form: str, unit: str = ""
) -> str:
    if value is None:
        return "-"
    known = (value[name] for name in ("mean", "low", "high"))
    mean, *ends = (format(scale * number, form) for number in known if number is not None)
    return f"{mean}{unit} [{', '.join(ends)}]" if ends else f"{mean}{unit}"

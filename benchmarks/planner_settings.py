r"""What settings of the planner are worth, on people who are reported nowhere else.

    python -m benchmarks.planner_settings --domain bomb_defusal --rounds 0 1 5 --horizon 12 24 60
    python -m benchmarks.planner_settings --domain bomb_defusal --rounds 0 1 5 --horizon 12 24 \
        --terminal-value True
    python -m benchmarks.planner_settings --domain bomb_defusal --rounds 0 1 5 \
        --min-standard-errors 0 1 2
    python -m benchmarks.planner_settings --domain search_rescue --rounds 0 1 5 \
        --min-standard-errors 0 1 2
    python -m benchmarks.planner_settings --domain search_rescue --rounds 0 1 5 \
        --terminal-value False
    python -m benchmarks.planner_settings --domain driving --rounds 0 1 5 \
        --min-standard-errors 0 1 2
    python -m benchmarks.planner_settings --domain driving --rounds 0 1 5 \
        --min-standard-errors 1 2 --seeds 105 106 107 108 109 110 111 112 113 114
    python -m benchmarks.planner_settings --domain highway --population diverse --played 4 \
        --seeds 100 101 102 --rounds 20 --min-standard-errors 0 1 2

Each combination of the settings given, of `PlannerOptions`, is played by ``mirror`` for the same
people, fitted to each number of rounds, in the setting in which they see least. Rows are added to
docs/results/planner_settings.csv after each combination, and what is there is not done again.
Without settings the table of the rows that are there is printed.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import cast

import numpy as np
import torch
import tyro

from benchmarks._rows import rows_in
from benchmarks.tables import TITLES
from mirror_ppl.communication.planners import PlannerOptions
from mirror_ppl.domains import get_domain
from mirror_ppl.evaluation.assistance import play_together, speaker
from mirror_ppl.evaluation.learned import Plannable
from mirror_ppl.evaluation.learners import Group, learn
from mirror_ppl.evaluation.study_summary import interval

ROWS = Path(__file__).parents[1] / "docs/results/planner_settings.csv"
SETTINGS = ("horizon", "terminal_value", "min_standard_errors", "enumerate_above")
COLUMNS = ("domain", "population", "seed", "person", "rounds", *SETTINGS, "net", "oracle")


@dataclass(frozen=True)
class Options:
    """People, and settings to try."""

    domain: str = "bomb_defusal"
    """The world."""
    population: str = "paper"
    """Which simulated people: paper or diverse."""
    seeds: tuple[int, ...] = (100, 101, 102, 103, 104)
    """Seeds of people and rounds."""
    people: int = 2
    """People of each seed."""
    played: int = 2
    """Rounds that each plays with messages."""
    draws: int = 64
    """Posterior draws to plan with."""
    rounds: tuple[int, ...] = (0, 1, 5, 20)
    """Numbers of rounds that the posterior is fitted to."""
    horizon: tuple[int, ...] = ()
    """Steps that are looked ahead; the world's unless given."""
    terminal_value: tuple[bool, ...] = ()
    """Whether the best return from the horizon on is added; as in the world unless given."""
    min_standard_errors: tuple[float, ...] = ()
    """Standard errors that a message has to gain; the world's unless given."""
    enumerate_above: tuple[float, ...] = ()
    """Probability of action sequences that are enumerated; the world's unless given."""


def tried(options: Options) -> list[dict[str, float]]:
    """Return the combinations of settings, those of the world where none are given."""
    own = PlannerOptions.of(options.domain)
    values = [getattr(options, name) or (getattr(own, name),) for name in SETTINGS]
    return [dict(zip(SETTINGS, each, strict=True)) for each in product(*values)]


def measure(options: Options) -> None:
    """Play what is not in the file yet, and add its rows."""
    known = {_key(row) for row in rows_in(ROWS)} if ROWS.exists() else set()
    setting = get_domain(options.domain).settings[-1]
    for seed in options.seeds:
        group = Group(options.domain, setting, options.population, options.people, seed)
        listeners = group.listeners(options.played)
        for rounds in options.rounds:
            learned = None
            for changes in tried(options):
                row = {"domain": options.domain, "population": options.population}
                row |= {"seed": seed, "rounds": rounds} | {k: float(v) for k, v in changes.items()}
                if _key(row) in known:
                    continue
                learned = learned or cast(Plannable, learn("mirror", group, rounds, seed, 1))
                planner = PlannerOptions.of(options.domain, **changes)
                people = [
                    replace(one, person=learned.person(number, options.draws))
                    for number, one in enumerate(listeners)
                ]
                net = [
                    [
                        float(played.net.mean())
                        for played in play_together(
                            people,
                            [speaker(name, one, planner, seed + n) for n, one in enumerate(people)],
                        )
                    ]
                    for name in ("mirror", "oracle")
                ]
                _add(
                    [
                        row | {"person": person, "net": f"{own:.4f}", "oracle": f"{best:.4f}"}
                        for person, (own, best) in enumerate(zip(*net, strict=True), 1)
                    ]
                )


def _key(row: dict) -> tuple:
    return (
        *(str(row[name]) for name in ("domain", "population")),
        *(float(row[name]) for name in ("seed", "rounds", *SETTINGS)),
    )


def _add(rows: Sequence[dict]) -> None:
    new = not ROWS.exists()
    with ROWS.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if new:
            writer.writeheader()
        writer.writerows(rows)


def table(rows: Sequence[dict[str, str]]) -> str:
    """Return the table of docs/decisions.md: net return minus the oracle's, with intervals."""
    amounts = sorted({int(row["rounds"]) for row in rows})
    heads = [f"{amount} round{'s' * (amount != 1)}" for amount in amounts]
    names = ("world", "horizon", "value at it", "standard errors", "people", *heads)
    lines = [" | ".join(names), " | ".join(["---"] * 4 + ["---:"] * (1 + len(amounts)))]
    places = {_place(row) for row in rows}
    for place in sorted(places, key=lambda one: (*one[:2], *map(float, one[2:]))):
        world, population, horizon, terminal, errors, _ = place
        here = [row for row in rows if _place(row) == place]
        name = TITLES.get(world, world.replace("_", " ")).lower()
        cells = [f"{name}, {population}", f"{float(horizon):g}"]
        cells += ["best" if float(terminal) else "none", f"{float(errors):g}"]
        cells.append(str(len({(row["seed"], row["person"]) for row in here})))
        for amount in amounts:
            loss = [
                float(row["net"]) - float(row["oracle"])
                for row in here
                if int(row["rounds"]) == amount
            ]
            cells.append(_shown(loss))
        lines.append(" | ".join(cells))
    return "\n".join(f"| {line} |" for line in lines)


def _place(row: dict[str, str]) -> tuple[str, ...]:
    return tuple(row[name] for name in ("domain", "population", *SETTINGS))


def _shown(loss: Sequence[float]) -> str:
    if not loss:
        return ""
    found = interval(np.array(loss))
    return f"{found.mean:+.2f} [{found.low:+.2f}, {found.high:+.2f}]"


def main(options: Options) -> None:
    torch.set_num_threads(1)
    if any(getattr(options, name) for name in SETTINGS):
        measure(options)
    print(table(rows_in(ROWS)))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

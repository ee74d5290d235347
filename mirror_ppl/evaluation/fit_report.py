"""The report that `python -m mirror_ppl.fit` prints."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import prod
from typing import Any

from rich.table import Table

from mirror_ppl.console import console_for_tables
from mirror_ppl.inference.results.criticism import OK, UNCHECKED
from mirror_ppl.inference.results.identifiability import NEGLIGIBLE
from mirror_ppl.inference.results.prior_conflict import conflict_line
from mirror_ppl.inference.weighted import HIGH_PARETO_K
from mirror_ppl.models.family import KIND, model_of
from mirror_ppl.models.implants import NOTICES
from mirror_ppl.models.loading import MIRROR, model_name

OTHERS = "-"
"""Entry for implants of a model that is not the person's most probable one."""
FEW = 20
"""Effective draws below which a pooled posterior is coarse."""
MOST_DOUBTED = 20
"""Most people for whom reasons are printed."""
WIDTH = 184
"""Characters of a line, where the terminal's width is unknown."""
BORDER = 3
"""Characters between columns."""


def show_fit(summary: dict[str, Any], unit: str) -> None:
    """Print the report of a fit.

    Args:
        summary: as in `summary.json`.
        unit: of people's sight.
    """
    sites = summary["people"][0]["implants"]
    what = f"sees ({unit})"
    if any(name.startswith(NOTICES) for name in sites):
        what = "notices (probability at a step)"
    named = any("most_probable" in one for one in sites.values())
    _show_people(
        summary,
        f"What each person {what} and how they decide: {summary['domain']}, {summary['setting']}",
        "median [90% interval] truth, if known"
        + ("; of named values the most probable one (its probability)" if named else "")
        + ("; -: of another model than the most probable one" if KIND in sites else ""),
    )
    if several := summary["several_numbers"]:
        names = ", ".join(f"{name} ({prod(shape)})" for name, shape in several.items())
        print(f"Implants of several numbers are in posterior.nc alone: {names}")
    if prior := summary.get("prior_from"):
        print(f"Prior: the population of {prior}")
    _show_predictions(summary["people"])
    people, wrong = summary["people"], summary["contradictions"]
    print(_served(people))
    if wrong["contradicting"]:
        print(f"{wrong['contradicting']} of {wrong['steps']} steps contradict the next observation")
    doubtful = [
        person["id"] for person in people if (person.get("pareto_k") or 0.0) > HIGH_PARETO_K
    ]
    if doubtful:
        print(
            f"Importance weights are not to be relied on for {', '.join(doubtful)} (Pareto k above "
            f"{HIGH_PARETO_K}): another --human-model may do better, or --guide svi or nuts, if "
            "perception reads no continuous site"
        )
    few = [
        person["id"]
        for person in people
        if person.get("rounds", 1) and person.get("effective_draws", FEW) < FEW
    ]
    if few:
        print(
            f"Fewer than {FEW} effective draws under the population for {', '.join(few)}: it is at "
            "odds with what they did, or far from the prior; their posterior is coarse"
        )
    for site, conflict in (summary["prior_conflicts"] or {}).items():
        print(conflict_line(site, conflict))
    _show_checks(people, model_name(summary.get("human_model", "")))
    identified = [person["identifiability"] for person in people if "identifiability" in person]
    _show_entropy(identified, sites)
    tested = [person["test"] for person in people if person["test"]]
    if not tested:
        print("No rounds were held out, so predictions are not scored (--train-rounds)")
    else:
        nll = sum(test["nll"] for test in tested) / len(tested)
        line = f"Held-out actions: {nll:.3f} nats an action on average"
        above = [test["nll"] - test["floor"] for test in tested if test["floor"] is not None]
        if above:
            line += f", {sum(above) / len(above):.3f} above the people's own entropy"
            if len(above) < len(tested):
                line += f", which is known of {len(above)} of {len(tested)}"
        print(line)


def _show_checks(people: Sequence[dict[str, Any]], model: str) -> None:
    """Print the people whom the model does not explain, with reasons."""
    checked = [person for person in people if person["check"]["verdict"] != UNCHECKED]
    if not checked:
        print("Model check: none without training rounds")
        return
    doubted = [person for person in checked if person["check"]["verdict"] != OK]
    hint = ""
    if doubted and model == MIRROR:
        hint = "; --human-model all weighs other models of them, which takes much longer"
    print(f"Model check: {len(checked) - len(doubted)} of {len(checked)} people ok{hint}")
    for person in doubted[:MOST_DOUBTED]:
        check = person["check"]
        print(f"  {person['id']} {check['verdict']}: {'; '.join(check['reasons'])}")
    if len(doubted) > MOST_DOUBTED:
        print(f"  and {len(doubted) - MOST_DOUBTED} more, in summary.json")


def _served(people: Sequence[dict[str, Any]]) -> str:
    """Describe who was inferred by which engine; the most frequent one without people's ids."""
    by_engine: dict[str, list[str]] = {}
    for person in people:
        by_engine.setdefault(person["engine"], []).append(person["id"])
    (most, ids), *others = sorted(by_engine.items(), key=lambda one: -len(one[1]))
    line = f"Inferred by the engine {most}: {len(ids)} of {len(people)} people"
    return line + "".join(f"; {engine}: {', '.join(some)}" for engine, some in others)


def _show_people(summary: dict[str, Any], title: str, caption: str) -> None:
    """Print what was inferred of each person."""
    people, newcomer = summary["people"], summary.get("newcomer")
    columns = []
    for name in sorted(people[0]["implants"], key=lambda name: name != KIND):
        cells = [
            _cell(person["implants"][name]) if _is_own(name, person) else OTHERS
            for person in people
        ]
        if newcomer is not None:
            cells.append(_cell(newcomer[name] | {"truth": None}))
        columns.append([name.replace("sight_", "").replace("_", " "), *cells])
    who = ["person", *(person["id"] for person in people)]
    if newcomer is not None:
        who.append("newcomer")
    _show_blocks(title, who, columns, caption, None if newcomer is None else len(people))


def _is_own(site: str, person: dict[str, Any]) -> bool:
    """True unless a site is of a model that is not a person's most probable one."""
    kind = person["implants"].get(KIND, {}).get("most_probable")
    return kind is None or model_of(site) in ("", kind)


def _show_blocks(
    title: str,
    who: Sequence[str],
    columns: Sequence[Sequence[str]],
    caption: str,
    ends: int | None,
) -> None:
    """Print a table, or several below each other if it would be too wide.

    Args:
        title: above it.
        who: the first column.
        columns: the others.
        caption: below it.
        ends: number of the row after which there is a line.
    """
    console = console_for_tables(WIDTH)
    # Printed apart, as tables would wrap them to their own width.
    console.print(title, style="italic", markup=False, highlight=False)
    for block in _side_by_side(who, columns, console.width):
        table = Table()
        for number, column in enumerate([who, *block]):
            table.add_column(column[0], justify="right" if number else "left")
        for number, row in enumerate(zip(who, *block, strict=True)):
            if number:
                table.add_row(*row, end_section=number == ends)
        console.print(table)
    console.print(f"({caption})", style="dim", markup=False, highlight=False)


def _show_predictions(people: Sequence[dict[str, Any]]) -> None:
    """Print each person's scores of held-out actions and verdict of the model check."""
    scores: dict[str, list[str]] = {}
    title, caption = "Whether the model explains each person", ""
    if any(person["test"] for person in people):
        title = "How held-out actions are predicted, and whether the model explains each person"
        caption = (
            "NLL in nats an action; floor: entropy of the person's own choices; base rate: NLL of "
            "the frequencies of their actions in training; no implants: NLL if the person were the "
            "robot"
        )
        for name in ("NLL", "floor", "accuracy"):
            own = [(person["test"] or {}).get(name.lower()) for person in people]
            scores[name] = [_number(value, 3) for value in own]
        for name in ("base_rate", "no_implants"):
            own = [person["check"][f"nll_{name}"] for person in people]
            scores[name.replace("_", " ")] = [_number(value, 3) for value in own]
    scores["model check"] = [person["check"]["verdict"] for person in people]
    _show_blocks(
        title,
        ["person", *(person["id"] for person in people)],
        [[name, *cells] for name, cells in scores.items()],
        caption,
        ends=None,
    )


def _side_by_side(
    who: Sequence[str], columns: Sequence[Sequence[str]], width: int
) -> list[list[Sequence[str]]]:
    """Split columns into as few blocks as fit, each beside the names."""
    blocks: list[list[Sequence[str]]] = []
    left = 0
    for column in columns:
        needed = max(map(len, column)) + BORDER
        if not blocks or left < needed:
            blocks.append([])
            left = width - max(map(len, who)) - BORDER - 1
        blocks[-1].append(column)
        left -= needed
    return blocks


def _show_entropy(people: list[dict[str, Any]], sites: Iterable[str]) -> None:
    """Print the posterior entropy of perceptual implants and the most informative scenario."""
    if not people:
        return
    entropy, shared = (
        sum(person[part]["together"] for person in people) / len(people)
        for part in ("entropy", "shared_with_policy")
    )
    expected = {
        name: sum(person["scenarios"][name]["expected"] for person in people) / len(people)
        for name in people[0]["scenarios"]
    }
    best = max(expected, key=lambda name: expected[name], default="")
    amounts = [person["entropy"]["together"] for person in people]
    amounts += [one["expected"] for person in people for one in person["scenarios"].values()]
    if max(amounts) < NEGLIGIBLE:
        noticing = any(name.startswith(NOTICES) for name in sites)
        but = ", not counting how soon they notice things" if noticing else ""
        print(f"Posterior entropy of the perceptual implants: none{but}")
        return
    line = f"Joint posterior entropy of the perceptual implants: {entropy:.2f} nats on average "
    line += f"({shared:.2f} shared with the policy implants)"
    if best and expected[best] >= NEGLIGIBLE:
        line += f'. Most informative next scenario: "{best}" '
        line += f"(expected information gain {expected[best]:.2f} nats)"
    print(line)


def _cell(implant: dict[str, Any]) -> str:
    if "most_probable" in implant:
        return f"{implant['most_probable']} ({implant['probability']:.2f})"
    text = f"{_number(implant['median'])} [{_number(implant['q05'])}, {_number(implant['q95'])}]"
    return text if implant["truth"] is None else f"{text} {_number(implant['truth'])}"


def _number(value: float | None, digits: int = 2) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.{digits}f}"

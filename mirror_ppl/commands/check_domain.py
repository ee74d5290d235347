"""`python -m mirror_ppl.check_domain`: check a world that a user wrote."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tyro.conf import Positional

if TYPE_CHECKING:
    from mirror_ppl.domains import World

PROGRAM = "python -m mirror_ppl.check_domain"
DESCRIPTION = """Check a world of your own, whose code is run: print one line for each fault, or
list what the world offers. The exit status is 1 if something is wrong, and 2 if it cannot be
loaded. docs/adding_a_world.md describes how to write a world."""
EXAMPLES = {
    "a world that the documentation explains": "docs/examples/round_table.py:RoundTable",
}
"""Arguments, by what they are for."""


@dataclass(frozen=True)
class Options:
    """Which world."""

    domain: Positional[str]
    """The world: path/to/file.py:Class."""


def main(options: Options) -> int:
    """Print what is wrong, or what the world offers; return the exit status.

    Raises:
        DomainError: the file or class is missing, does not import, or is no world.
    """
    from mirror_ppl.domains.capabilities import remarks_on
    from mirror_ppl.domains.checking import faults_of
    from mirror_ppl.domains.registry import load_world
    from mirror_ppl.errors import DomainError

    world = load_world(options.domain)
    faults, remark = faults_of(world) or _of_record(world), ""
    if not faults:
        try:
            remark = remarks_on(world)
        except DomainError as error:  # more rounds than those of the check have shown it
            faults = [str(error)]
    if faults:
        print(f"{world.name}: {len(faults)} thing{'s' * (len(faults) > 1)} wrong")
        for fault in faults:
            print(f"  {fault}")
        return 1
    _show(world, remark)
    return 0


def _of_record(world: World) -> list[str]:
    """Faults in the record of a world that is sound otherwise."""
    from mirror_ppl.communication.planners import PlannerOptions
    from mirror_ppl.domains.record import PARTS
    from mirror_ppl.domains.registry import know
    from mirror_ppl.errors import MirrorError
    from mirror_ppl.models.sizes import sizes_of
    from mirror_ppl.training.self_model_options import SelfModelOptions

    know(world)
    found = []
    for name, made in (
        ("training", lambda: SelfModelOptions.of(world.name)),
        ("planning", lambda: PlannerOptions.of(world.name)),
        ("networks", lambda: sizes_of(world)),
    ):
        try:
            made()
        except (MirrorError, TypeError, ValueError) as error:
            found.append(f"{name}: {error}")
    for name in PARTS:
        try:
            world.record.part(name)
        except MirrorError as error:
            found.append(str(error))
    return found


def _show(world: World, remark: str) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from mirror_ppl.console import console_for_tables
    from mirror_ppl.domains.capabilities import capabilities
    from mirror_ppl.domains.controls import bounds_in_words
    from mirror_ppl.user_code import misspelt

    table = Table(title=f"{world.name}: nothing wrong", box=SIMPLE_HEAD, title_justify="left")
    for column in ("capability", "here", "what it gives"):
        table.add_column(column)
    for one, own in capabilities(world):
        table.add_row(one.method, "its own" if own else one.otherwise, one.gives)
    for name, meant in misspelt(type(world)).items():
        print(f"warning: {name} is no member of worlds; perhaps you meant {meant}")
    console_for_tables(100).print(table)
    items = ", ".join(f"{len(m.items)} {m.name}" for m in world.modalities)
    reach = ", ".join(f"{edge:g}" for edge in world.reach_bins)
    actions = f"actions: {', '.join(world.actions)}"
    if world.controls:
        actions = f"controls: {bounds_in_words(world.controls)}; {len(world.actions)} actions"
    print(f"items: {items}; {actions}; {world.horizon} steps a round")
    print(
        f"settings: {', '.join(world.settings)}; thresholds of sight ({world.reach_unit}): {reach}"
    )
    record = world.record
    print(
        f"record: consistency {record.consistency:g}, value_error {record.value_error:g}, "
        f"likelihood_power {record.likelihood_power:g}, sight_scale {record.sight_scale}"
    )
    print(remark)

"""Worlds by name: those of the package, of files of users, and of installed packages."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path

from mirror_ppl.domains.base import Domain
from mirror_ppl.domains.bomb_defusal import BombDefusal
from mirror_ppl.domains.driving import Driving
from mirror_ppl.domains.search_rescue import SearchRescue
from mirror_ppl.domains.world import World
from mirror_ppl.errors import DomainError, UnknownNameError
from mirror_ppl.user_code import class_in_file, describe

ENTRY_POINTS = "mirror_ppl.domains"
"""Group under which installed packages name their worlds."""
DOMAINS: dict[str, Domain] = {
    domain.name: domain for domain in (Driving(), SearchRescue(), BombDefusal())
}
"""The package's own worlds by name."""
_ADDED: dict[str, World] = {}


def added_worlds() -> tuple[World, ...]:
    """Worlds that were added, for other processes to add."""
    return tuple(_ADDED.values())


def add_domain(world: World | type[World] | str) -> World:
    """Make a world known by its name, in place of another one that was added under it.

    Args:
        world: it or its class, or ``path/to/file.py:Class``, whose code is run.

    Raises:
        DomainError: it is no world, cannot be made, or has the name of one of the package.
    """
    if isinstance(world, str):
        path, colon, kind = world.rpartition(":")
        if not colon:
            raise DomainError(f'"{world}" is not of the form path/to/file.py:Class')
        world = class_in_file(Path(path), kind, World, DomainError)
    if isinstance(world, type) and issubclass(world, World):
        try:
            world = world()
        except (Exception, SystemExit) as error:
            raise DomainError(f"{world.__name__} cannot be made: {describe(error)}") from error
    if not isinstance(world, World):
        raise DomainError(f"a world is derived from mirror_ppl.World, not {type(world).__name__}")
    if world.name in DOMAINS:
        raise DomainError(f"{type(world).__name__}: mirror_ppl has a world {world.name} itself")
    _ADDED[world.name] = world
    return world


def domain_of(world: World | type[World] | str) -> Domain:
    """A world by name, or one of somebody's own; see `get_domain` and `add_domain`."""
    return get_domain(world) if isinstance(world, str) else add_domain(world)


def get_domain(name: str) -> Domain:
    """Return a world.

    Args:
        name: of one of the package, or of one that was added or that an installed package has
            under the entry point ``mirror_ppl.domains``; or ``path/to/file.py:Class``, whose code
            is run.

    Raises:
        UnknownNameError: there is none, listing the known ones.
        DomainError: the file or class is missing, does not import, or is no world.
    """
    if not isinstance(name, str):
        raise UnknownNameError.of("domain", name, DOMAINS)
    if name in DOMAINS:
        return DOMAINS[name]
    if name in _ADDED:
        return _ADDED[name]
    if ".py:" in name:
        return add_domain(name)
    for entry in entry_points(group=ENTRY_POINTS, name=name):
        return add_domain(entry.load())
    installed = [entry.name for entry in entry_points(group=ENTRY_POINTS)]
    raise UnknownNameError.of("domain", name, dict.fromkeys([*DOMAINS, *_ADDED, *installed]))

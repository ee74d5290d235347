"""Worlds by name: those of the package, of files of users, and of installed packages."""

from __future__ import annotations

import hashlib
import inspect
import os
from importlib.metadata import entry_points
from pathlib import Path

from mirror_ppl.domains.base import Domain
from mirror_ppl.domains.bomb_defusal import BombDefusal
from mirror_ppl.domains.checking import require_sound
from mirror_ppl.domains.driving import Driving
from mirror_ppl.domains.highway import Highway
from mirror_ppl.domains.search_rescue import SearchRescue
from mirror_ppl.domains.world import World
from mirror_ppl.errors import DomainError, UnknownNameError, shown
from mirror_ppl.user_code import class_in_file, describe

ENTRY_POINTS = "mirror_ppl.domains"
"""Group under which installed packages name their worlds."""
DOMAINS: dict[str, Domain] = {
    domain.name: domain for domain in (Driving(), SearchRescue(), BombDefusal(), Highway())
}
"""The package's own worlds by name, of which recordings and a self-model ship."""
CODE = "_hash_of_file"
"""Attribute of the class of a user's world."""
_ADDED: dict[str, World] = {}
_LOADED: dict[tuple[Path, str, int], World] = {}
"""Worlds loaded from files, by file, class and modification time."""


def added_worlds() -> tuple[World, ...]:
    """Return the worlds that were added, for other processes to add."""
    return tuple(_ADDED.values())


def known_domains() -> tuple[Domain, ...]:
    """Return the package's own worlds and those that were added."""
    return (*DOMAINS.values(), *_ADDED.values())


def load_world(specification: str | type[World] | World) -> World:
    """Load a world from ``path/to/file.py:Class``, whose code is run, or a class; unchecked.

    Raises:
        DomainError: the file or class is missing, does not import, is no world or cannot be made.
    """
    world = specification
    if isinstance(world, str):
        path, colon, kind = world.rpartition(":")
        if not colon or not kind.isidentifier():
            raise DomainError(f"{shown(world)} is not of the form path/to/file.py:Class")
        world = class_in_file(Path(path), kind, World, DomainError)
    if isinstance(world, type) and issubclass(world, World):
        if missing := sorted(world.__abstractmethods__):
            raise DomainError(
                f"{world.__name__} needs {', '.join(missing)}; see docs/adding_a_world.md"
            )
        try:
            world = world()
        except DomainError:
            raise
        except (Exception, SystemExit) as error:
            raise DomainError(f"{world.__name__} cannot be made: {describe(error)}") from error
    if not isinstance(world, World):
        raise DomainError(f"a world is derived from mirror_ppl.World, not {type(world).__name__}")
    if world.name in DOMAINS:
        raise DomainError(f"{type(world).__name__}: mirror_ppl has a world {world.name} itself")
    return world


def add_domain(world: World | type[World] | str) -> World:
    """Register a world by its name, replacing a world added under that name.

    Args:
        world: it or its class, or ``path/to/file.py:Class``, whose code is run.

    Raises:
        DomainError: it is no world, cannot be made, breaks the contract of worlds (see
            :mod:`mirror_ppl.domains.checking`), or has the name of a world of the package.
    """
    return know(require_sound(load_world(world)))


def code_of(domain: Domain) -> str:
    """Return a hash of the file of a user's world; empty for the package's own worlds.

    It is computed once and kept by the class: other processes do not have the file.
    """
    if domain.name in DOMAINS:
        return ""
    kind = type(domain)
    if CODE not in vars(kind):
        try:
            content = Path(inspect.getfile(kind)).read_bytes()
            setattr(kind, CODE, hashlib.sha256(content).hexdigest())
        except (OSError, TypeError):  # written at a prompt
            setattr(kind, CODE, "")
    return vars(kind)[CODE]


def know(world: World) -> World:
    """Register a world that was already checked."""
    code_of(world)
    _ADDED[world.name] = world
    return world


def domain_of(world: World | type[World] | str) -> Domain:
    """Return a world by name, or add a user's world; see `get_domain` and `add_domain`."""
    return get_domain(world) if isinstance(world, str) else add_domain(world)


def get_domain(name: str) -> Domain:
    """Return a world.

    Args:
        name: of a world of the package, an added world, or a world that an installed package has
            under the entry point ``mirror_ppl.domains``; or ``path/to/file.py:Class``, whose code
            is run.

    Raises:
        UnknownNameError: no world has that name; lists the known ones.
        DomainError: the file or class is missing, does not import, or is no world.
    """
    if not isinstance(name, str):
        raise UnknownNameError.of("domain", name, DOMAINS)
    if name in DOMAINS:
        return DOMAINS[name]
    if name in _ADDED:
        return _ADDED[name]
    if ".py:" in name:
        return _of_file(name)
    for entry in entry_points(group=ENTRY_POINTS, name=name):
        try:
            kind = entry.load()
        except (Exception, SystemExit) as error:
            raise DomainError(f"{entry.value} does not import: {describe(error)}") from error
        world = add_domain(kind)
        if world.name != name:
            raise DomainError(f"{entry.value}: is called {world.name}, but its entry point {name}")
        return world
    installed = [entry.name for entry in entry_points(group=ENTRY_POINTS)]
    known = dict.fromkeys([*DOMAINS, *_ADDED, *installed])
    message = f"{UnknownNameError.of('domain', name, known)}"
    raise UnknownNameError(
        f"{message}; a world of your own is path/to/file.py:Class (--domain, mirror_ppl.add_domain)"
    )


def _of_file(specification: str) -> World:
    path, _, kind = specification.rpartition(":")
    try:
        key = Path(path).resolve(), kind, os.stat(path).st_mtime_ns
    except (OSError, ValueError):
        return add_domain(specification)  # which says what is wrong
    if key not in _LOADED:
        _LOADED[key] = add_domain(specification)
    return know(_LOADED[key])

"""Code of users: loading of files, their source, faults in one line, what is not theirs."""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import os
import sys
import traceback
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, TypeVar

from mirror_ppl.errors import MirrorError

ALMOST = 0.85
"""Similarity from which another name counts as misspelt."""
Base = TypeVar("Base")
_FILES: set[Path] = set()
_PACKAGE = Path(__file__).resolve().parent
_LIBRARIES = ("mirror_ppl", "torch", "pyro", "builtins", "abc", "typing", "dataclasses")


def class_in_file(path: Path, name: str, base: type[Base], error: type[MirrorError]) -> type[Base]:
    """Import a file of a user and return a class that it defines.

    Args:
        path: the file.
        name: of the class.
        base: class from which it must be derived.
        error: class of the exception to raise.

    Raises:
        MirrorError: ``error``; the file or class is missing, does not import, or is another one.
    """
    if not os.path.isfile(path):
        there = "is not a regular file" if os.path.exists(path) else "there is no such file"
        raise error(f"{path}: {there}")
    # Files of the same name in different folders are different modules.
    folder = hashlib.blake2b(os.fsencode(path.resolve()), digest_size=4).hexdigest()
    module_name = f"_{base.__name__.lower()}_of_{path.stem}_{folder}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise error(f"{path}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    remember_file(path)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as fault:
        sys.modules.pop(module_name, None)
        raise error(f"{path} does not import: {describe(fault, path)}") from fault
    chosen = getattr(module, name, None)
    if isinstance(chosen, type) and issubclass(chosen, base):
        return chosen
    classes = [
        key
        for key, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, base) and value is not base
    ]
    package = base.__module__.rpartition(".")[0]
    raise error(
        f"{path} has no class {name} derived from {package}.{base.__name__}; "
        f"it has: {', '.join(classes) or 'none'}"
    )


def remember_file(path: Path) -> None:
    """Register a file as one of users."""
    _FILES.add(path.resolve())


def remembered_files() -> tuple[Path, ...]:
    """Registered files of users, for other processes to register."""
    return tuple(_FILES)


def describe(error: BaseException, path: Path | None = None) -> str:
    """Describe an exception in one line, with the last line of the user's own file that it passed.

    Args:
        error: the exception.
        path: the file; any registered one unless given.
    """
    if isinstance(error, SyntaxError) and error.filename:
        return f"SyntaxError: {error.msg} ({Path(error.filename).name}, line {error.lineno})"
    frames = traceback.extract_tb(error.__traceback__)
    own = _own_frames(frames, _FILES if path is None else {path.resolve()})
    text = " ".join(str(error).split())
    if isinstance(error, SystemExit):
        text = f"the file ends the program, sys.exit({text})"
    else:
        text = f"{type(error).__name__}: {text}" if text else type(error).__name__
    if not frames:
        return text
    called = isinstance(error, TypeError) and not own
    if called and _PACKAGE in Path(frames[-1].filename).resolve().parents:
        return text  # the user's function could not be called, which the message says
    line = (own or frames)[-1]
    return f"{text} ({Path(line.filename).name}, line {line.lineno})"


def is_of_package(thing: object) -> bool:
    """True if an object's class, its bases and all of their methods come with this package.

    Methods that were replaced, in a class or in the object, are a user's.
    """
    kinds = type(thing).__mro__
    return all(map(_from_libraries, kinds)) and all(
        _functions_from_libraries(vars(one).values()) for one in (thing, *kinds) if vars(one)
    )


def is_own_method(thing: object, name: str) -> bool:
    """True if a user wrote a method of an object, in its class or in the object itself."""
    return not _functions_from_libraries([getattr(thing, name)])


def _functions_from_libraries(values: Iterable[Any]) -> bool:
    for value in values:
        # Properties and bound, static and class methods hold the function.
        for name in ("__func__", "fget", "func"):
            value = getattr(value, name, value)  # noqa: PLW2901
        if isinstance(value, FunctionType) and not _from_libraries(value):
            return False
    return True


def _from_libraries(defined: FunctionType | type) -> bool:
    # None if a class was executed without a module.
    return (defined.__module__ or "").partition(".")[0] in _LIBRARIES


def passed_user_code(error: BaseException) -> bool:
    """True if an exception was raised in a file of a user, or passed through one."""
    return bool(_own_frames(traceback.extract_tb(error.__traceback__), _FILES))


def _own_frames(frames: traceback.StackSummary, files: set[Path]) -> list[traceback.FrameSummary]:
    return [frame for frame in frames if Path(frame.filename).resolve() in files]


def misspelt(kind: type) -> dict[str, str]:
    """Return public attributes of a user's class that almost have the name of a member.

    Returns:
        The package's members that may have been meant, by attribute.
    """
    members, own = set[str](), set[str]()
    for base in kind.__mro__:
        package = base.__module__.partition(".")[0]
        if package == "mirror_ppl":
            members |= {*vars(base), *vars(base).get("__annotations__", {})}
        elif package not in _LIBRARIES:
            own |= {*vars(base)} - {*vars(base).get("_derived", ())}
    found = {}
    for name in sorted(own - members):
        close = get_close_matches(name, members - own, 1, ALMOST)
        if close and not name.startswith("_"):
            found[name] = close[0]
    return found


def source_of(kind: type) -> str:
    """Source of the file of a class, on all of which the class may depend."""
    try:
        return Path(inspect.getfile(kind)).read_text()
    except (OSError, TypeError):  # a class made in a notebook has no file
        return repr([(name, _code(member)) for name, member in sorted(vars(kind).items())])


def _code(member: Any) -> Any:
    """Bytecode of a function that was defined in a notebook."""
    code = member if isinstance(member, CodeType) else getattr(member, "__code__", None)
    if code is None:
        return None
    constants = [_code(one) or repr(one) for one in code.co_consts]
    return code.co_code.hex(), code.co_names, constants

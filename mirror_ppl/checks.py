"""Checks and conversion of arguments from Python; errors say what was expected.

Arrays may be torch tensors of any dtype, numpy arrays or lists of numbers. They are converted to
tensors of the package's dtypes: numbers in torch's default dtype, whole numbers as int64, flags as
bool.
"""

from __future__ import annotations

import operator
import os
from collections.abc import Iterable, Mapping
from math import isnan
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from mirror_ppl.errors import InputError, MirrorError, is_name, shown
from mirror_ppl.limits import MOST_SEED

Kind = TypeVar("Kind")


def require_kind(value: Any, kind: type[Kind], name: str) -> Kind:
    """Return the value if it is of that class.

    Raises:
        InputError: it is not.
    """
    if not isinstance(value, kind):
        raise InputError(f"{name} must be of the class {kind.__name__}, not {shown(value)}")
    return value


def require_methods(value: Any, methods: Iterable[str], name: str, what: str) -> None:
    """Check that a user's own object has the methods that it needs.

    Raises:
        InputError: it lacks one.
    """
    for method in methods:
        if isinstance(value, type) or not callable(getattr(value, method, None)):
            raise InputError(f"{name} must be {what}, with the method {method}, not {shown(value)}")


def as_path(value: str | os.PathLike[str], name: str = "path") -> Path:
    """Return a text or path as the path of a file.

    Raises:
        InputError: it is neither text nor a path.
    """
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{name} must be the path of a file, not {shown(value)}")
    return Path(value)


def whole_number(
    value: Any,
    name: str,
    least: int | None = None,
    most: int | None = None,
    error: type[MirrorError] = InputError,
) -> int:
    """Convert one whole number, of Python, numpy or torch, to an int.

    Raises:
        error: it is something else, True or False included, or beyond the limits.
    """
    try:
        if isinstance(value, bool) or getattr(value, "dtype", None) in (torch.bool, np.bool_):
            raise TypeError
        number = operator.index(value)
    except (TypeError, ValueError):
        raise error(f"{name} must be a whole number, not {shown(value)}") from None
    if least is not None and number < least and most is None:
        raise error(f"{name} must be at least {least}, not {number}")
    if (least is not None and number < least) or (most is not None and number > most):
        raise error(f"{name} must be from {least} to {most}, not {number}")
    return number


def seed_number(value: Any, name: str = "seed") -> int:
    """Convert a seed to an int.

    Raises:
        InputError: it is not a whole number, or too large.
    """
    return whole_number(value, name, 0, MOST_SEED)


def real_number(value: Any, name: str, least: float, most: float = float("inf")) -> float:
    """Convert one number within limits to a float.

    Raises:
        InputError: it is not a number, or beyond the limits.
    """
    try:
        if isinstance(value, bool | str | bytes):
            raise TypeError
        number = float(value)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{name} must be a number, not {shown(value)}") from None
    if isnan(number) or not least <= number <= most:
        limits = f"at least {least:g}" if most == float("inf") else f"from {least:g} to {most:g}"
        raise InputError(f"{name} must be {limits}, not {shown(value)}")
    return number


def as_tensor(value: Any, name: str, error: type[MirrorError] = InputError) -> Tensor:
    """Convert an array of numbers to a tensor; dtype and device stay.

    Raises:
        error: it is not an array of real numbers, or some of them are masked.
    """
    if isinstance(value, Tensor):
        if value.is_complex() or value.layout != torch.strided:
            raise error(f"{name} is a tensor of {value.dtype}, {value.layout}, expected numbers")
        return value.detach()
    try:
        array = np.asarray(value)
    except Exception:  # of numpy, or of an object's conversion to an array
        raise error(f"{name} is {shown(value)}, expected an array of numbers") from None
    if array.dtype.kind not in "biuf":
        kind = f" of {array.dtype}" if array.ndim else ""
        raise error(f"{name} is {shown(value)}{kind}, expected an array of numbers")
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise error(f"{name} has masked entries, expected an array of numbers")
    kind = {"b": np.bool_, "f": np.float64}.get(array.dtype.kind, np.int64)
    # A copy in memory order: torch takes neither negative strides nor foreign byte orders.
    return torch.from_numpy(np.array(array, dtype=kind, order="C"))


def numbers(value: Any, name: str, device: torch.device | None = None) -> Tensor:
    """Convert numbers to torch's default dtype; the shape stays.

    Raises:
        InputError: they are not numbers.
    """
    return as_tensor(value, name).to(torch.get_default_dtype()).to(device)


def whole_numbers(value: Any, name: str, device: torch.device | None = None) -> Tensor:
    """Convert whole numbers to int64; the shape stays.

    Raises:
        InputError: some are not whole, or True and False.
    """
    given = as_tensor(value, name)
    if given.dtype == torch.bool:
        raise InputError(f"{name} has True or False, expected whole numbers")
    if given.is_floating_point():
        bad = given != given.round()  # also of nan
        if bad.any():
            raise InputError(f"{name} has {given[bad][0]:g}, expected whole numbers")
    return given.to(torch.long).to(device)


def flags(value: Any, name: str, device: torch.device | None = None) -> Tensor:
    """Convert True or False, or 1 or 0, to bool; the shape stays.

    Raises:
        InputError: some are neither.
    """
    given = as_tensor(value, name)
    if given.dtype != torch.bool:
        bad = (given != 0) & (given != 1)
        if bad.any():
            raise InputError(f"{name} has {given[bad][0]:g}, expected True or False, or 1 or 0")
    return given.to(torch.bool).to(device)


def require_shape(value: Tensor, shape: tuple[int, ...], name: str) -> None:
    """Check that a tensor has that shape.

    Raises:
        InputError: it has another.
    """
    if value.shape != shape:
        raise InputError(f"{name} has shape {tuple(value.shape)}, expected {shape}")


def require_keys(
    value: Any,
    keys: Iterable[str],
    name: str,
    error: type[MirrorError] = InputError,
    *,
    all_of_them: bool = True,
) -> Mapping[str, Any]:
    """Return the mapping if it has these keys, all of them or some, and no others.

    Raises:
        error: it is not a mapping, or keys are missing or too many.
    """
    keys = tuple(keys)
    if not isinstance(value, Mapping):
        raise error(f"{name} must be a dict with {', '.join(keys)}, not {shown(value)}")
    if set(value) - set(keys) or (all_of_them and set(keys) - set(value)):
        given = ", ".join(key if is_name(key) else shown(key) for key in value)
        raise error(f"{name} has {given or 'nothing'}, expected {', '.join(keys)}")
    return value


def listed(value: Any, name: str, what: str, error: type[MirrorError] = InputError) -> list[Any]:
    """Return the entries of a list, tuple, range, array or other iterable.

    Raises:
        error: it is not an iterable, or one text.
    """
    if isinstance(value, np.ndarray | Tensor):
        value = value.tolist()
    if isinstance(value, str | bytes | Mapping) or not isinstance(value, Iterable):
        raise error(f"{name} must be a list of {what}, not {shown(value)}")
    return list(value)

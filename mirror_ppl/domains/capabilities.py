"""Which methods of a world are its own: what it offers beyond what every world has."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

Method = TypeVar("Method", bound=Callable[..., Any])
MARK = "__left_out__"


def left_out(method: Method) -> Method:
    """Mark a method that only says that a world does without; overriding it offers it."""
    setattr(method, MARK, True)
    return method


def offers(domain: Any, capability: str) -> bool:
    """Whether a world has a method of that name that does more than say that there is none."""
    method = getattr(type(domain), capability, None)
    return method is not None and not hasattr(method, MARK)

"""Timing: processor seconds of this process by stage of work."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from time import process_time


@dataclass
class Clock:
    """Measures processor seconds by stage; those of a nested stage count once, for the inner one.

    Attributes:
        seconds: by name of the stage.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    _stages: list[str] = field(default_factory=list)
    _since: float = 0.0

    def _turn(self) -> None:
        now = process_time()
        if self._stages:
            name = self._stages[-1]
            self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now


_clock: ContextVar[Clock | None] = ContextVar("clock", default=None)


@contextmanager
def clocked() -> Iterator[dict[str, float]]:
    """Measure the stages of work in this context; yields seconds by stage, filled as they end."""
    clock = Clock()
    token = _clock.set(clock)
    try:
        yield clock.seconds
    finally:
        _clock.reset(token)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Count this context as a stage, if it is within `clocked`."""
    clock = _clock.get()
    if clock is None:
        yield
        return
    clock._turn()
    clock._stages.append(name)
    try:
        yield
    finally:
        clock._turn()
        clock._stages.pop()


def add_seconds(total: dict[str, float], more: Mapping[str, float]) -> None:
    """Add seconds by stage to a total, in place."""
    for name, seconds in more.items():
        total[name] = total.get(name, 0.0) + seconds

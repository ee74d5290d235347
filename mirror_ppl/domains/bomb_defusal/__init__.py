"""Bomb defusal: the world, and what the package knows of it in `record`."""

from mirror_ppl.domains.bomb_defusal.world import (
    WAIT,
    BombDefusal,
    BombState,
)

__all__ = [
    "BombDefusal",
    "BombState",
    "WAIT",
]

"""Bomb defusal: the world, its people, human models and settings."""

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

"""Search and rescue: the world, its people, pictures and settings."""

from mirror_ppl.domains.search_rescue.world import (
    MOVES,
    UTTERANCES,
    RescueState,
    SearchRescue,
)

__all__ = [
    "MOVES",
    "RescueState",
    "SearchRescue",
    "UTTERANCES",
]

"""Search and rescue: the world, and what the package knows of it in `record`."""

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

"""Search and rescue: the world, its people, pictures and settings."""

from mirror_ppl.domains.search_rescue.moves import MOVES, RescueState
from mirror_ppl.domains.search_rescue.world import UTTERANCES, SearchRescue

__all__ = [
    "MOVES",
    "RescueState",
    "SearchRescue",
    "UTTERANCES",
]

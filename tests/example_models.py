"""Human models that ship, in the worlds in which they make sense."""

from mirror_ppl.domains import DOMAINS
from mirror_ppl.models.variants import VARIANTS

NOT_IN_BOMBS = ("one-radius", "noticing", "forgetting")
"""Models of how far away things are, which does not count in bomb defusal."""
SHIPPED = [
    (world, name)
    for world in DOMAINS
    for name in VARIANTS
    if world != "bomb_defusal" or name not in NOT_IN_BOMBS
]

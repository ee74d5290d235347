"""Highway driving with lidar and speech: the world as a simulator, without a self-model yet."""

from mirror_ppl.domains.highway.state import HighwayState
from mirror_ppl.domains.highway.world import Highway

__all__ = ["Highway", "HighwayState"]

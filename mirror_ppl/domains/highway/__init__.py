"""Highway driving with lidar and speech.

The Gymnasium environment ``mirror_ppl/Highway-v0`` needs highway-env (``pip install
'mirror_ppl[highway]'``); everything else does without.
"""

from mirror_ppl.domains.highway.state import HighwayState
from mirror_ppl.domains.highway.world import DirectHighway, Highway

__all__ = ["DirectHighway", "Highway", "HighwayState"]

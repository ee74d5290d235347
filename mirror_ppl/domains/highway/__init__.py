"""Highway driving with lidar and speech: the world as a simulator, without a self-model yet.

Importing it registers the Gymnasium environment ``mirror_ppl/Highway-v0``, which needs highway-env
(``pip install 'mirror_ppl[highway]'``); everything else does without.
"""

from gymnasium import register as _register
from gymnasium import registry as _registry

from mirror_ppl.domains.highway.state import HighwayState
from mirror_ppl.domains.highway.world import Highway

__all__ = ["Highway", "HighwayState"]

if "mirror_ppl/Highway-v0" not in _registry:
    _register("mirror_ppl/Highway-v0", "mirror_ppl.domains.highway.environment:HighwayEnv")

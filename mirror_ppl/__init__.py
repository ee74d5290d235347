"""MIRROR as a Pyro program: what a person sees, how they decide, and what a robot should tell them.

The models are in `mirror_ppl.models`, the ways to fit them in `mirror_ppl.inference`, the worlds in
`mirror_ppl.domains`; nothing of it is imported here, so that `import mirror_ppl` stays quick.
Gymnasium (0.06 s beyond numpy) only learns the names under which it can make the worlds.
"""

from gymnasium import register as _register

__version__ = "0.1.0"

_register("mirror_ppl/Driving-v0", "mirror_ppl.domains.driving_environment:DrivingEnv")
_register("mirror_ppl/SearchRescue-v0", "mirror_ppl.domains.rescue_environment:SearchRescueEnv")
_register("mirror_ppl/BombDefusal-v0", "mirror_ppl.domains.bomb_environment:BombDefusalEnv")

"""What MIRROR is compared with: models of people that are not built on the robot's own."""

from mirror_ppl.baselines.behaviour_cloning import (
    BehaviourClone,
    BehaviourCloneOptions,
    fit_behaviour_clone,
    held_out_nll,
)
from mirror_ppl.baselines.recurrent import SIGHTS, RecurrentNetworks, input_size, network_inputs

__all__ = [
    "SIGHTS",
    "BehaviourClone",
    "BehaviourCloneOptions",
    "RecurrentNetworks",
    "fit_behaviour_clone",
    "held_out_nll",
    "input_size",
    "network_inputs",
]

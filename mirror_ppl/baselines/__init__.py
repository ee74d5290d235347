"""Baselines for MIRROR: models of people that are not built on the robot's self-model."""

from mirror_ppl.baselines.behaviour_cloning import (
    BehaviourClone,
    BehaviourCloneOptions,
    fit_behaviour_clone,
)
from mirror_ppl.baselines.inputs import SIGHTS, input_size, network_inputs
from mirror_ppl.baselines.logistic import LogisticOptions, PooledLogistic, fit_pooled_logistic
from mirror_ppl.baselines.person import NetworkPerson
from mirror_ppl.baselines.pooled import as_one_person
from mirror_ppl.baselines.recurrent import RecurrentNetworks
from mirror_ppl.baselines.sqil import SoftQ, SoftQOptions, fit_soft_q
from mirror_ppl.baselines.training import held_out_nll

__all__ = [
    "SIGHTS",
    "BehaviourClone",
    "BehaviourCloneOptions",
    "LogisticOptions",
    "NetworkPerson",
    "PooledLogistic",
    "RecurrentNetworks",
    "SoftQ",
    "SoftQOptions",
    "as_one_person",
    "fit_behaviour_clone",
    "fit_pooled_logistic",
    "fit_soft_q",
    "held_out_nll",
    "input_size",
    "network_inputs",
]

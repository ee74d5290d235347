"""Exact posteriors over discrete sites, given all others: what engines are compared with."""

import torch

from mirror_ppl.likelihood.combinations import log_priors
from mirror_ppl.likelihood.enumeration import log_joints


def log_prior(human, table, policy):
    """Log prior probability ``[P, M]`` of each combination, given other sites ``[P, 1, ...]``."""
    draws = {name: value[None] for name, value in policy.items()}
    return log_priors(human, table.grid, draws, table.people)[0]


def log_joint(human, table, policy):
    """Log prior and likelihood ``[P, M]`` of each combination, given the same."""
    return log_joints(human, table, {name: value[None] for name, value in policy.items()})[0]


def marginals(table, log_weights):
    """Marginal probabilities ``[P, n]`` of each site, of log weights ``[P, M]``."""
    joint = torch.softmax(log_weights, -1).unflatten(-1, table.sizes)
    axes = range(1, joint.dim())
    return {
        site: joint.sum([other for other in axes if other != axis])
        for axis, site in zip(axes, table.sites, strict=True)
    }

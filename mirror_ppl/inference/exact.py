"""Exact posteriors over the discrete implants, given how a person decides.

The reference for every approximate guide: all combinations of the discrete sites that perception
depends on, each with its prior and likelihood, without sampling or optimization.
"""

from __future__ import annotations

from collections.abc import Mapping

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.inference.views import combination_scores, discrete_sites
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.view_table import ViewTable


def combination_values(human: HumanModel, table: ViewTable) -> dict[str, Tensor]:
    """Values ``[M]`` of the discrete sites of a table, one for each combination."""
    if not table.sites:
        return {}
    supports = discrete_sites(human)
    axes = torch.meshgrid(*(supports[site] for site in table.sites), indexing="ij")
    return {site: axis.flatten() for site, axis in zip(table.sites, axes, strict=True)}


@torch.no_grad()
def log_prior(human: HumanModel, table: ViewTable, policy: Mapping[str, Tensor]) -> Tensor:
    """Log prior probability ``[P, M]`` of each combination of the table's discrete sites.

    Args:
        human: the model of people.
        table: the recorded rounds.
        policy: values of all other sites, ``[P, 1, ...]`` or ``[1, 1, ...]``, on which the prior
            of the discrete ones may depend.
    """
    values = {
        site: value[:, None, None] for site, value in combination_values(human, table).items()
    }
    with (
        torch.random.fork_rng(devices=[]),
        poutine.trace() as trace,
        poutine.condition(data={**policy, **values}),
        pyro.plate("person", table.people, dim=-2),
    ):
        human.prior()
    total = torch.zeros(table.index.shape[-1], table.people, device=table.index.device)
    for site in table.sites:
        node = trace.trace.nodes[site]
        total = total + node["fn"].log_prob(node["value"]).squeeze(-1)
    return total.T


@torch.no_grad()
def log_joint(human: HumanModel, table: ViewTable, policy: Mapping[str, Tensor]) -> Tensor:
    """Log prior and likelihood ``[P, M]`` of each combination, given the other sites.

    Args:
        human: the model of people.
        table: the recorded rounds.
        policy: values of all other sites, ``[P, 1, ...]`` or ``[1, 1, ...]``.
    """
    with (
        torch.random.fork_rng(devices=[]),
        poutine.block(),
        poutine.condition(data=dict(policy)),
        pyro.plate("person", table.people, dim=-2),
    ):
        log_probabilities = human.act(human.prior(), table.belief, table.values)
    return log_prior(human, table, policy) + combination_scores(table, log_probabilities)


def marginals(table: ViewTable, log_weights: Tensor) -> dict[str, Tensor]:
    """Marginal probabilities ``[P, n]`` of each site, of log weights ``[P, M]``."""
    joint = torch.softmax(log_weights, -1).unflatten(-1, table.sizes)
    axes = range(1, joint.dim())
    return {
        site: joint.sum([other for other in axes if other != axis])
        for axis, site in zip(axes, table.sites, strict=True)
    }


def draw_combinations(
    human: HumanModel, table: ViewTable, log_weights: Tensor, number: int
) -> dict[str, Tensor]:
    """Draws ``[S, P, 1]`` of the table's sites, from log weights ``[P, M]``."""
    chosen = torch.multinomial(torch.softmax(log_weights, -1), number, replacement=True).T
    return {
        site: value[chosen][..., None] for site, value in combination_values(human, table).items()
    }

"""Tables with fewer moments: those of a round that likely policies do not tell apart are merged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from mirror_ppl.likelihood.policy_likelihoods import PolicyLikelihoods
from mirror_ppl.likelihood.round_views import ManyViews
from mirror_ppl.likelihood.view_table import NO_VIEW, ViewTable
from mirror_ppl.models.human import HumanModel


@torch.no_grad()
def merged_for(
    human: HumanModel, table: ViewTable, policies: Mapping[str, Tensor], resolution: float
) -> ViewTable:
    """Merge moments of a round whose recorded actions are as probable under all policies.

    Moments that a table keeps apart under draws from the prior are often alike under draws from
    the posterior.

    Args:
        human: the model of people.
        table: views of one person's rounds, without round latents.
        policies: draws ``[S, 1, 1, ...]`` of the implants that perception does not read.
        resolution: grid width of log-probabilities, see `Screening`.
    """
    likelihoods = PolicyLikelihoods(human, policies, len(next(iter(policies.values()))))
    found, place = likelihoods.merged(_views(table), policies, resolution)
    return replace(
        table,
        index=torch.where(table.index == NO_VIEW, NO_VIEW, place[table.index.clamp(min=0)]),
        moments=found.moments[None],
        belief=found.belief[None],
        values=found.values[None],
        acted=found.acted[None],
        view_counts=torch.tensor([len(found.moments)]),
    )


def _views(table: ViewTable) -> ManyViews:
    """Return the views of one person's rounds, with the round of each view and moment."""
    moments, device = table.moments[0], table.moments.device
    round_of_view = torch.zeros(len(moments), dtype=torch.long, device=device)
    for number, index in enumerate(table.index[0]):
        round_of_view[index[index != NO_VIEW]] = number
    real = moments != NO_VIEW
    rounds = torch.zeros(table.acted.shape[1], dtype=torch.long, device=device)
    rounds[moments[real]] = round_of_view[:, None].expand_as(moments)[real]
    belief, values, acted = table.belief[0], table.values[0], table.acted[0]
    return ManyViews(moments, belief, values, acted, round_of_view, rounds, table.rounds)

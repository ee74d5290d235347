"""The evidence lower bound with what people see summed out, as one sum over combinations.

Pyro's ``TraceEnum_ELBO`` gives every discrete site a dimension of its own. Here each person has one
dimension for the combinations of all of them that were never given up, of which there are far
fewer::

    E_guide [ log p(psi) + log sum_m p(m | psi) p(actions | m, psi) - log q(psi) ]
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.likelihood.densities import PLATES
from mirror_ppl.likelihood.enumeration import combination_values
from mirror_ppl.likelihood.table_program import TableProgram
from mirror_ppl.likelihood.view_table import ViewTable
from mirror_ppl.models.human import HumanModel


def marginal_elbo(
    human: HumanModel, table: ViewTable, guide: Callable[..., Mapping[str, Tensor]]
) -> Callable[[ViewTable], Tensor]:
    """Negative ELBO in nats of one draw of a guide, as a function of a table.

    Args:
        human: a model all of whose discrete sites are read by ``perceive``.
        table: any of this model.
        guide: over its continuous sites.
    """
    values = combination_values(human, table)

    def loss(table: ViewTable) -> Tensor:
        guided = poutine.trace(guide).get_trace(table)
        replayed = poutine.replay(TableProgram(human), trace=guided)
        combinations = {
            site: value[table.possible_numbers][..., None]  # [C, P, 1]
            for site, value in values.items()
        }
        trace = poutine.trace(poutine.condition(replayed, data=combinations)).get_trace(table)
        trace.compute_log_prob()
        total = torch.zeros((), device=table.index.device)
        joint = torch.zeros((), device=table.index.device)
        for node in trace.nodes.values():
            if node["type"] != "sample":
                continue
            # Which sites depend on what is seen shows in their dimensions.
            if node["log_prob"].dim() > PLATES:
                joint = joint + node["log_prob"]
            else:
                total = total + node["log_prob"].sum()
        return guided.log_prob_sum() - total - torch.logsumexp(joint, 0).sum()

    return loss

"""Evidence lower bound with perceptual implants summed out over possible combinations.

Pyro's ``TraceEnum_ELBO`` enumerates every discrete site in a dimension of its own. Here each person
has one dimension for the combinations of all sites that were not dropped, of which there are far
fewer::

    E_guide [ log p(psi) + log sum_m p(m | psi) p(actions | m, psi) - log q(psi) ]
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from pyro import poutine
from pyro.infer import TraceEnum_ELBO
from pyro.infer.elbo import ELBO
from torch import Tensor

from mirror_ppl.likelihood.compiled import Compiled, ViewTables
from mirror_ppl.likelihood.densities import PLATES


class MarginalELBO(ELBO):
    """An ELBO for ``pyro.infer.SVI``, for a program that is compiled to tables of views.

    Args:
        compiled: a program whose discrete sites are all read by perception.
    """

    def __init__(self, compiled: ViewTables) -> None:
        super().__init__(max_plate_nesting=PLATES)
        self.compiled = compiled
        self._values = compiled.table.grid

    def _get_trace(self, *_: Any) -> Any:
        """Unused: the loss takes one draw of the guide, and all combinations at once."""
        raise NotImplementedError

    def differentiable_loss(
        self, model: Callable[..., Any], guide: Callable[..., Any], *args: Any, **kwargs: Any
    ) -> Tensor:
        """Negative ELBO in nats, of one draw of the guide over the continuous sites."""
        guided = poutine.trace(guide).get_trace(*args, **kwargs)
        combinations = {
            site: value[self.compiled.table.possible_numbers][..., None]  # [C, P, 1]
            for site, value in self._values.items()
        }
        replayed = poutine.condition(poutine.replay(model, trace=guided), data=combinations)
        trace = poutine.trace(replayed).get_trace(*args, **kwargs)
        trace.compute_log_prob()
        total = torch.zeros((), device=self.compiled.table.index.device)
        joint = torch.zeros((), device=self.compiled.table.index.device)
        for node in trace.nodes.values():
            if node["type"] != "sample":
                continue
            # Sites that depend on perceptual implants have an additional dimension.
            if node["log_prob"].dim() > PLATES:
                joint = joint + node["log_prob"]
            else:
                total = total + node["log_prob"].sum()
        return guided.log_prob_sum() - total - torch.logsumexp(joint, 0).sum()

    def loss(self, *args: Any, **kwargs: Any) -> float:
        """Negative ELBO in nats."""
        with torch.no_grad():
            return self.differentiable_loss(*args, **kwargs).item()

    def loss_and_grads(self, *args: Any, **kwargs: Any) -> float:
        """Negative ELBO in nats; gradients are added to the parameters."""
        loss = self.differentiable_loss(*args, **kwargs)
        loss.backward()
        return loss.item()


def elbo_of(compiled: Compiled) -> ELBO:
    """Choose the ELBO that sums out a program's discrete sites."""
    if isinstance(compiled, ViewTables) and compiled.sums_over_combinations:
        return MarginalELBO(compiled)
    return TraceEnum_ELBO(max_plate_nesting=PLATES, strict_enumeration_warning=False)

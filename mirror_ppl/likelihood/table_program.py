"""A human program on a table of views: its likelihood, and the program for Pyro's engines."""

from __future__ import annotations

from collections.abc import Mapping

import pyro
from torch import Tensor

from mirror_ppl.likelihood.densities import choices
from mirror_ppl.likelihood.view_table import RecordedActions, ViewTable
from mirror_ppl.models.human import HumanModel


def log_likelihoods(human: HumanModel, implants: Mapping[str, Tensor], table: ViewTable) -> Tensor:
    """Log-likelihood ``[..., P, U]`` of what was recorded under each sight of a round.

    Runs inside the person plate. Round latents are summed out.

    Args:
        human: the model of people.
        implants: as :meth:`HumanModel.prior` returned them, ``[..., P, 1]``.
        table: the rounds of P people and the distinct views of them.
    """
    _, moments = choices(human, implants, table.belief, table.values, table.acted)
    return of_moments(human, implants, table, moments)


def of_moments(
    human: HumanModel, implants: Mapping[str, Tensor], table: ViewTable, moments: Tensor
) -> Tensor:
    """The log-likelihood ``[..., P, U]``, given that of each moment ``[..., P, N]``."""
    if table.attention is None:
        return table.along_views(moments)
    chances = table.attention.log_chances(human, implants, table.rounds)
    return table.attention.marginal(table.along_views(moments), chances)


class TableProgram:
    """The program of a human model on tables of views.

    Args:
        human: the model of people.
    """

    def __init__(self, human: HumanModel) -> None:
        self.human = human

    def __call__(self, table: ViewTable) -> None:
        """Run it on the rounds of P people, conditioned on what was recorded."""
        human = self.human
        with pyro.plate("person", table.people, dim=-2):
            implants = human.prior()
            scores = table.scores(log_likelihoods(human, implants, table))
            pyro.sample(
                "actions",
                RecordedActions(scores, table.place_of(implants), table.recorded.shape[1:]),
                obs=table.recorded[:, None],
            )

"""A human program on a table of views: likelihoods, and the Pyro program for engines."""

from __future__ import annotations

from collections.abc import Mapping

import pyro
from torch import Tensor

from mirror_ppl.likelihood.densities import choices
from mirror_ppl.likelihood.view_table import RecordedActions, ViewTable
from mirror_ppl.models.human import HumanModel

RECORDED = "recorded actions"
"""Site of the actions of all rounds."""


def log_likelihoods(human: HumanModel, implants: Mapping[str, Tensor], table: ViewTable) -> Tensor:
    """Log-likelihood ``[..., P, U]`` of the recordings under each sight of a round.

    Runs inside the person plate. Round latents are summed out.

    Args:
        human: the model of people.
        implants: as :meth:`HumanModel.prior` returned them, ``[..., P, 1]``.
        table: the rounds of P people and their distinct views.
    """
    _, moments = choices(human, implants, table.belief, table.values, table.acted)
    return of_moments(human, implants, table, moments)


def of_moments(
    human: HumanModel, implants: Mapping[str, Tensor], table: ViewTable, moments: Tensor
) -> Tensor:
    """Log-likelihood ``[..., P, U]`` of sights, given that of moments ``[..., P, N]``."""
    if table.attention is None:
        return table.along_views(moments)
    probabilities = table.attention.log_probabilities(human, implants, table.rounds)
    return table.attention.marginal(table.along_views(moments), probabilities)


class TableProgram:
    """The program of a human model on tables of views.

    Args:
        human: the model of people.
    """

    def __init__(self, human: HumanModel) -> None:
        self.human = human

    def __call__(self, table: ViewTable) -> None:
        """Run the program on the rounds of P people, conditioned on the recorded actions."""
        human = self.human
        with pyro.plate("person", table.people, dim=-2):
            implants = human.prior()
            scores = table.scores(log_likelihoods(human, implants, table))
            pyro.sample(
                RECORDED,
                RecordedActions(scores, table.place_of(implants), table.recorded.shape[1:]),
                obs=table.recorded[:, None],
            )

"""Posterior predictive probabilities of recorded people's actions."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.combinations import needs_points, perceived_names, perceived_sites
from mirror_ppl.likelihood.compiled import Sequential
from mirror_ppl.likelihood.grid import Grid, combination_number
from mirror_ppl.likelihood.predictive import predict_actions
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.models.human import HumanModel, has_own_program
from mirror_ppl.models.prior import checked_draws
from mirror_ppl.models.recorded import check_rounds

PREDICTED_VALUES = 128
"""Sampled values of attention per round in predictions."""


def predict_rounds(
    human: HumanModel, rounds: Demonstrations, draws: Mapping[str, Tensor]
) -> Tensor:
    """Log-probabilities ``[S, P, B, T, A]`` of actions, each given the earlier ones of its round.

    People are predicted one by one, so that those of one do not depend on the others.

    Args:
        human: the model of people.
        rounds: rounds of P people.
        draws: draws of their implants ``[S, P, 1, ...]``.

    Raises:
        InputError: the rounds are of another domain, or the draws are not of these people.
        DemonstrationsError: the rounds are impossible in the domain's world.
        HumanModelError: the draws are not those of the model's sites.
    """
    check_rounds(human, rounds)
    draws = checked_draws(human, draws, rounds.num_people)
    if has_own_program(human):
        return Sequential(human, rounds).predict(draws)
    read, sizes = perceived_names(human), {}
    points = needs_points(human)
    if not points:
        sizes = {site: len(support) for site, support in perceived_sites(human).items()}
    parts = []
    for person in range(rounds.num_people):
        own = {name: value[:, [person]] for name, value in draws.items()}
        recorded = rounds.part(range(person, person + 1))
        # Only combinations among the draws: exact views, without screening or merging.
        grid, some = None, None
        if points:
            grid = Grid({site: own[site][:, 0, 0] for site in read}, read=read)
        else:
            drawn = combination_number({site: own[site][:, 0, 0] for site in sizes}, sizes).unique()
            some = [drawn.to(rounds.actions.device)]  # also where there are no sites
        table = build_view_table(
            human, recorded, some, likely=own, values=PREDICTED_VALUES, grid=grid
        )
        parts.append(predict_actions(human, table, own))
        if bool(parts[-1].isnan().any()):
            raise HumanModelError(f"{type(human).__name__}.act returns nan")
        del table
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)


def chosen_log_probability(log_probabilities: Tensor, rounds: Demonstrations) -> Tensor:
    """Log-probability ``[S, P, B, T]`` of recorded actions; 0 in padding."""
    actions = rounds.actions.clamp(min=0).expand(log_probabilities.shape[:-1])
    chosen = log_probabilities.gather(-1, actions[..., None]).squeeze(-1)
    return torch.where(rounds.mask, chosen, 0.0)

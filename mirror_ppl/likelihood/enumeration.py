"""Exact posteriors over the perceptual implants, given the policy implants.

Enumerates all joint values of the sites that perception reads, each with its prior and likelihood,
without sampling or optimization: the reference for every approximate guide.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.combinations import log_priors
from mirror_ppl.likelihood.densities import choices
from mirror_ppl.likelihood.table_program import log_likelihoods, of_moments
from mirror_ppl.likelihood.tables import combination_scores
from mirror_ppl.likelihood.view_table import ViewTable
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel
from mirror_ppl.randomness import forked

CHUNK = 2**19
"""Views and moments, summed over draws, that are computed at once: what a cache holds."""
IMPROBABLE = -1e4
"""Log-probability that stands for 0 where gradients are taken."""


@torch.no_grad()
def log_joints(
    human: HumanModel,
    table: ViewTable,
    draws: Mapping[str, Tensor],
    combinations: Tensor | None = None,
    log_prior: Tensor | None = None,
) -> Tensor:
    """Log prior plus log-likelihood of each combination under S draws, ``[S, P, M]``.

    Valid only if :func:`acts_on_beliefs`.

    Args:
        human: the model of people.
        table: the recorded rounds.
        draws: values of all other sites, ``[S, P, 1, ...]`` or ``[S, 1, 1, ...]``.
        combinations: numbers ``[M]`` of the combinations; all by default.
        log_prior: log prior ``[M]`` of these, which replaces the model's.
    """
    number = len(next(iter(draws.values()))) if draws else 1
    grid = table.grid
    if combinations is not None and log_prior is None:
        grid = grid.chosen(combinations)
    size = max(1, CHUNK // (table.moments.shape[:2].numel() + table.acted.numel()))
    parts = []
    for begin in range(0, number, size):
        some = {name: value[begin : begin + size] for name, value in draws.items()}
        with conditioned(some, min(size, number - begin), table.people):
            likelihoods = log_likelihoods(human, human.prior(), table)
        scores = combination_scores(table, likelihoods, combinations)
        if log_prior is None:
            parts.append(log_priors(human, grid, some, table.people) + scores)
        else:
            parts.append(log_prior[None, None] + scores)
    return torch.cat(parts)


@contextmanager
def conditioned(draws: Mapping[str, Tensor], number: int, people: int) -> Iterator[None]:
    """Condition the program on S draws ``[S, P, 1, ...]``; missing sites are sampled."""
    with (
        forked(),
        poutine.block(),
        poutine.condition(data=dict(draws)),
        pyro.plate("draw", number, dim=-3),
        pyro.plate("person", people, dim=-2),
    ):
        yield


def expected_counts(
    human: HumanModel,
    table: ViewTable,
    draws: Mapping[str, Tensor],
    log_weights: Tensor,
    combinations: Tensor,
    log_prior: Tensor | None,
) -> Tensor:
    """Expected counts of each action at each moment, ``[N, A]``.

    The expectation is over the unobserved percepts and attention. By Fisher's identity it is the
    gradient of the log-likelihood with respect to that of the moments.

    Args:
        human: the model of people.
        table: views of one person's rounds.
        draws: values of the other sites ``[S, 1, 1, ...]``.
        log_weights: log weights of the draws, ``[S]``.
        combinations: possible combinations of what perception reads, ``[G]``.
        log_prior: log prior of these ``[G]``, if it does not depend on the other sites.
    """
    number = len(log_weights)
    grid = table.grid.chosen(combinations)
    with conditioned(draws, number, 1), torch.enable_grad():
        implants = human.prior()
        with torch.no_grad():
            _, moments = choices(human, implants, table.belief, table.values, table.acted)
        moments = moments.expand(number, *moments.shape[-2:])
        # Sums of which all terms are impossible have no gradient.
        moments = moments.clamp(min=IMPROBABLE).requires_grad_()
        likelihoods = of_moments(human, implants, table, moments)
        joint = combination_scores(table, likelihoods, combinations)[:, 0]
        if log_prior is None:
            log_prior = log_priors(human, grid, draws, 1)[:, 0]
        total = (joint + log_prior).logsumexp(-1)
        (counts,) = torch.autograd.grad(total.sum(), moments)
    weights = log_weights.softmax(0).to(counts)
    often = weights @ counts[:, 0]  # [N]
    actions = often.new_zeros(len(often), len(human.domain.actions))
    return actions.scatter(-1, table.acted[0][:, None], often[:, None])


def acts_on_beliefs(human: HumanModel, sites: Iterable[str]) -> bool:
    """True if percepts affect actions through beliefs alone.

    If ``act`` reads one of the ``sites`` that ``perceive`` reads, likelihoods of views do not
    suffice.
    """
    return not _acted_on(human, sites)


def require_acting_on_beliefs(human: HumanModel, sites: Iterable[str]) -> None:
    """Refuse models for which :func:`acts_on_beliefs` is false.

    Raises:
        HumanModelError: ``act`` reads one of the sites.
    """
    both = _acted_on(human, sites)
    if both:
        raise HumanModelError(
            f"act() reads a site that perceive() reads, too ({', '.join(sorted(both))}); only the "
            "engines svi and nuts can fit this"
        )


def _acted_on(human: HumanModel, sites: Iterable[str]) -> set[str]:
    """Return those of the sites that ``act`` reads."""
    return set(dependencies(human).actions) & set(sites)


def draw_combinations(
    human: HumanModel, table: ViewTable, log_weights: Tensor, number: int
) -> dict[str, Tensor]:
    """Draw ``[S, P, 1]`` values of the table's sites by log weights ``[P, M]``."""
    chosen = torch.multinomial(torch.softmax(log_weights, -1), number, replacement=True).T
    return {site: value[chosen[..., None]] for site, value in table.grid.items()}

"""Posteriors by adaptive importance sampling.

Draws of the policy implants (sites that perception does not read) come from a proposal that is
adapted stage by stage; perceptual implants are marginalized exactly under each draw. The posterior
is consistent for every proposal, given enough draws (:mod:`mirror_ppl.inference.sampler`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from pyro.distributions import MultivariateStudentT
from torch import Tensor

from mirror_ppl.checks import real_number, whole_number
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.hierarchical_proposal import RelativeProposal, dependent_sites
from mirror_ppl.inference.sampler import NoScalars, Proposal, Sampler
from mirror_ppl.inference.weighted import Weighted
from mirror_ppl.likelihood.view_table import ViewTable
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import unconstrained

PLAIN_STAGES = 2
"""Stages after which the residual is proposed in any case."""
LEARNED_FROM = 64.0
"""Least number of effective draws to fit a proposal to: moments of fewer are unreliable, and their
proposal might miss parts of the posterior. If there are fewer, weights are tempered until this
number is reached."""
FEW = 16.0
"""Number of effective draws up to which the residual is proposed at once."""
TAILS = 8.0
"""Degrees of freedom of the proposal. In unconstrained space priors of probabilities have
exponential tails, which are heavier than Gaussian ones."""
COARSE_DRAWS, COARSE_ENOUGH = 256, 64.0
"""Proposals of a stage, and effective draws that are enough, if another pass follows."""
PRUNING_DRAWS = 64
"""Draws from the prior after which combinations of discrete sites are dropped."""


@dataclass(frozen=True)
class ImportanceOptions:
    """Settings of adaptive importance sampling.

    Attributes:
        proposals: draws of each stage.
        enough: effective draws at which no stage is added.
        stages: largest number of stages.
        wider: factor on the covariance of weighted draws that gives the proposal's scale matrix
            after the first stage.
        prune_margin: nats behind the best, under each of the first draws, at which a combination
            of discrete sites is dropped.
        resolution: after the first stage, moments of a round are merged if log-probabilities of the
            recorded actions under likely draws round to the same multiples of this (if there are
            many moments); 0 for never, as where screening is off.
    """

    proposals: int = 512
    enough: float = 400.0
    stages: int = 8
    wider: float = 1.2
    prune_margin: float = 12.0
    resolution: float = 0.015

    def __post_init__(self) -> None:
        # Proposals are fitted to the spread of draws.
        for name, least in (("proposals", 2), ("stages", 0)):
            object.__setattr__(self, name, whole_number(getattr(self, name), name, least))
        for name in ("enough", "wider", "prune_margin", "resolution"):
            object.__setattr__(self, name, real_number(getattr(self, name), name, 0))


def coarse(options: ImportanceOptions) -> ImportanceOptions:
    """Reduced settings for passes over a person's rounds before the last."""
    return replace(
        options,
        proposals=min(COARSE_DRAWS, options.proposals),
        enough=min(COARSE_ENOUGH, options.enough),
    )


@torch.no_grad()
def sample_importance(
    human: HumanModel,
    table: ViewTable,
    options: ImportanceOptions,
    near: Weighted | None = None,
) -> Weighted:
    """Weighted draws of one person by adaptive importance sampling.

    The first stage draws from the prior. Each later stage draws the scalar sites, in unconstrained
    space, from a Student t distribution with the moments of the weighted draws so far, and discrete
    sites of the policy by their probabilities so far. If that is not enough, stages also propose
    the residual of the policy. While few draws have all the weight, weights are tempered before
    proposals are fitted (Koblents and Miguez, *A population Monte Carlo scheme with transformed
    weights*, 2015).

    Args:
        human: the model of people.
        table: views of one person's rounds.
        options: settings.
        near: draws from a similar posterior, whose moments are used from the first stage on.
    """
    sampler = Sampler(human, table)
    few = min(PRUNING_DRAWS, options.proposals)
    sampler.draw(few)
    sampler.prune(options.prune_margin)
    if near is not None and sampler.sites:
        place = unconstrained(sampler.sites, near.policy)
        sampler.propose(near_to(sampler, place, near, options), options.proposals)
    elif options.proposals > few:
        sampler.draw(options.proposals - few)
    return adapt(sampler, options)


@torch.no_grad()
def adapt(sampler: Sampler, options: ImportanceOptions) -> Weighted:
    """Add stages that propose near all weighted draws so far, until enough are effective.

    After the first weighing, many moments are merged (:meth:`Sampler.merge`).

    Args:
        sampler: sampler of one person, with some draws. See :func:`sample_importance`.
        options: settings.
    """
    for stage in range(options.stages if sampler.sites or sampler.supports else 0):
        found = sampler.weighted()
        if found.effective >= options.enough:
            return found
        few = found.effective <= FEW
        found = found.tempered(LEARNED_FROM)
        if stage == 0:
            sampler.merge(found, options.resolution)
        if not sampler.proposes_residual and (few or stage >= PLAIN_STAGES):
            sampler.learn_residual(found)
        sampler.learn_discrete(found)
        sampler.propose(near_to(sampler, sampler.place, found, options), options.proposals)
    return sampler.weighted()


def near_to(
    sampler: Sampler, place: Tensor, found: Weighted, options: ImportanceOptions
) -> Proposal:
    """A proposal of the scalar sites with the moments of weighted draws at places ``[S, D]``."""
    if not sampler.sites:
        return NoScalars()
    found = found.tempered(LEARNED_FROM)

    def fit(some: Tensor) -> MultivariateStudentT:
        return _heavy_tailed(some, found.log_weights, options.wider)

    dependent = dependent_sites(sampler.human, sampler.sites)
    if not dependent:
        return fit(place)
    return RelativeProposal(sampler.human, sampler.sites, dependent, place, fit)


def _heavy_tailed(place: Tensor, log_weights: Tensor, wider: float) -> MultivariateStudentT:
    weights = log_weights.exp().to(place)[:, None]
    mean = (weights * place).sum(0)
    centred = place - mean
    covariance = wider * (weights * centred).T @ centred
    # Where few draws have all the weight, their spread is not informative.
    floor = 1e-3 * place.var(0) + 1e-8
    if not bool(covariance.isfinite().all()):
        raise HumanModelError(
            "draws of the implants have no finite variance: priors with heavy tails, such as a "
            "StudentT with few degrees of freedom, need a transformation, such as dist.LogNormal"
        )
    spread = torch.linalg.cholesky(covariance + torch.diag(floor))
    return MultivariateStudentT(place.new_tensor(TAILS), mean, spread)

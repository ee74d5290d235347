"""Laplace approximation of the residual of a policy, as a proposal.

Given all else of a draw, the residual's last layer enters logits linearly, so the posterior of its
weights ``w`` is nearly Gaussian::

    q(w | rest) = Normal(mode, (prior precision + Fisher information at the mode)^-1)

Percepts and attention are unobserved, so each moment is weighted by its expected count. Expected
counts are the gradient of the log-likelihood with respect to the log-probabilities of actions
(Fisher's identity), and are thus correct for everything that a human model sums out. As this is a
proposal only, draws get importance weights by their exact likelihood.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from pyro import poutine
from torch import Tensor
from torch.distributions import MultivariateNormal

from mirror_ppl.likelihood.enumeration import conditioned
from mirror_ppl.likelihood.view_table import ViewTable
from mirror_ppl.models import implants as implant_priors
from mirror_ppl.models.human import HumanModel

SITE = "residual_out"
NEWTON_STEPS, CURVATURES = 4, 2
"""Newton steps to the mode, and how many of them recompute the curvature."""
DRAWS = 128
"""Draws that are computed at once; bounds memory."""
MOMENTS = 512
"""Largest number of moments, those with the largest expected counts."""
COUNTED = 0.97
"""Share of all expected counts at which fewer moments are used."""


@dataclass(frozen=True)
class ResidualProposal:
    """Proposes a residual's last layer, given draws of all other sites of one person.

    Attributes:
        human: the model of people; it samples ``residual_in`` and ``residual_out``.
        belief: beliefs at the selected moments ``[1, N, Z]``.
        values: action values there ``[1, N, A]``.
        counts: expected counts of each action there ``[N, A]``, each counting as often as in the
            density (:attr:`HumanModel.likelihood_power`).
    """

    human: HumanModel
    belief: Tensor
    values: Tensor
    counts: Tensor

    @classmethod
    def of(cls, human: HumanModel, table: ViewTable, counts: Tensor) -> ResidualProposal:
        """Build the proposal from the table of one person.

        Args:
            human: the model of people.
            table: views of the person's rounds.
            counts: expected counts of each action at each moment, ``[N, A]``.
        """
        belief, values = table.belief[0], table.values[0]
        often = counts.sum(-1)
        ordered, places = often.sort(descending=True)
        most = int((ordered.cumsum(0) < COUNTED * ordered.sum()).sum()) + 1
        some = places[: min(most, MOMENTS)]
        # Counts of other moments are added to the moment with the nearest belief.
        nearest = torch.cdist(belief, belief[some]).argmin(-1)
        counts = counts.new_zeros(len(some), counts.shape[-1]).index_add(0, nearest, counts)
        counts = human.likelihood_power * counts
        return cls(human, belief[some][None], values[some][None], counts)

    def gaussian(self, draws: Mapping[str, Tensor]) -> MultivariateNormal:
        """``q(w | rest)`` over weights ``[S, W]``, given draws ``[S, 1, 1, ...]`` of the rest."""
        number = len(draws[SITE])
        rest = {**draws, SITE: torch.zeros_like(draws[SITE])}
        with conditioned(rest, number, 1), poutine.trace() as trace:
            implants = self.human.prior()
            without = self.human.act(implants, self.belief, self.values)
        without = without.expand(number, *without.shape[1:])[:, 0]  # [S, N, A]
        # A larger belief begins with the robot's own.
        belief = self.belief[..., : self.human.self_model.latent]
        features = implant_priors.residual_features(implants, belief)[:, 0]  # [S, N, R]
        scale = trace.trace.nodes[SITE]["fn"].base_dist.scale.flatten()[0]
        return _laplace(without, features, self.counts, scale)


def _laplace(
    without: Tensor, features: Tensor, counts: Tensor, scale: Tensor
) -> MultivariateNormal:
    """Laplace approximation of weights ``[S, R A]`` of a multinomial logistic regression.

    Args:
        without: offset of the logits ``[S, N, A]``.
        features: ``[S, N, R]``.
        counts: ``[N, A]``.
        scale: standard deviation of the weights' prior.
    """
    weights, precision = [], []
    for some in torch.arange(len(features)).split(DRAWS):
        best, curvature = _mode(without[some], features[some], counts, scale)
        weights.append(best)
        precision.append((curvature + curvature.mT) / 2)  # symmetric up to rounding
    return MultivariateNormal(torch.cat(weights), precision_matrix=torch.cat(precision))


def _mode(
    without: Tensor, features: Tensor, counts: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor]:
    """Mode of the weights ``[S, R A]`` by Newton's method, and the precision there."""
    number, _, size = features.shape
    actions = without.shape[-1]
    # Moments last: operations over few actions are much faster on a leading dimension.
    without, counts, across = (part.mT.contiguous() for part in (without, counts, features))
    weights = without.new_zeros(number, actions, size)
    precision = factor = without.new_zeros(0)
    total = counts.sum(0)
    columns, places = _pairs(actions), _pairs(size)
    first, second = torch.triu_indices(size, size)
    products = (across[:, first] * across[:, second]).mT  # [S, N, R (R + 1) / 2]
    prior = torch.eye(size * actions).to(without) / scale**2
    for step in range(NEWTON_STEPS):
        probability = (without + weights @ across).softmax(-2)  # [S, A, N]
        often = total * probability
        slope = (counts - often) @ features - weights / scale**2
        if step < CURVATURES:
            shares = torch.cat([-often[:, a, None] * probability[:, a:] for a in range(actions)], 1)
            shares[:, columns.diagonal()] += often
            blocks = (shares @ products)[:, columns][..., places]  # [S, A, A, R, R]
            precision = blocks.permute(0, 3, 1, 4, 2).flatten(3).flatten(1, 2) + prior
            factor = torch.linalg.cholesky(precision)
        change = torch.cholesky_solve(slope.mT.flatten(1)[..., None], factor)[..., 0]
        weights = weights + change.unflatten(1, (size, actions)).mT
    return weights.mT.flatten(1), precision


def _pairs(size: int) -> Tensor:
    """Index ``[size, size]`` of each unordered pair, in the order of the upper triangle."""
    first, second = torch.triu_indices(size, size)
    which = torch.zeros(size, size, dtype=torch.long)
    which[first, second] = which[second, first] = torch.arange(len(first))
    return which

"""Where to look for the residual of a policy: near the weights that explain a person's rounds best.

Given all else of a draw, the residual's last layer enters logits linearly, so what rounds say of
its weights ``w`` is nearly Gaussian (a Laplace approximation)::

    q(w | rest) = Normal(mode, (prior precision + Fisher information at the mode)^-1)

under rounds in which each moment counts as often as it is likely to have come about: what somebody
saw, and attended to, is not known. Those expected counts are the gradient of the log-likelihood by
the log-probabilities of actions (Fisher's identity), so they are right for whatever a human model
sums out. It is a proposal only: draws are weighted by what their rounds really say.
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
"""Steps to the best weights; at so many of them is it worked out how curved the likelihood is."""
DRAWS = 128
"""What is worked out at once; bounds memory."""
MOMENTS = 512
"""So many moments are looked at, those that are expected to have come about most often."""
COUNTED = 0.97
"""Or fewer, if this share of all that was done was done at them."""


@dataclass(frozen=True)
class ResidualProposal:
    """Proposes a residual's last layer for draws of all else of one person.

    Attributes:
        human: the model of people; it samples ``residual_in`` and ``residual_out``.
        belief: of the moments that count ``[1, N, Z]``.
        values: action values there ``[1, N, A]``.
        counts: how often each action is expected to have been taken there ``[N, A]``.
    """

    human: HumanModel
    belief: Tensor
    values: Tensor
    counts: Tensor

    @classmethod
    def of(cls, human: HumanModel, table: ViewTable, counts: Tensor) -> ResidualProposal:
        """Of a table of one person.

        Args:
            human: the model of people.
            table: views of the person's rounds.
            counts: how often each action is expected at each moment, ``[N, A]``.
        """
        belief, values = table.belief[0], table.values[0]
        often = counts.sum(-1)
        ordered, places = often.sort(descending=True)
        most = int((ordered.cumsum(0) < COUNTED * ordered.sum()).sum()) + 1
        some = places[: min(most, MOMENTS)]
        # Each of the others counts as the one in which somebody believes much the same.
        nearest = torch.cdist(belief, belief[some]).argmin(-1)
        counts = counts.new_zeros(len(some), counts.shape[-1]).index_add(0, nearest, counts)
        return cls(human, belief[some][None], values[some][None], counts)

    def gaussian(self, draws: Mapping[str, Tensor]) -> MultivariateNormal:
        """``q(w | rest)`` of draws ``[S, 1, 1, ...]`` of everything else, of ``[S, W]``."""
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
    """The Laplace approximation of weights ``[S, R A]`` of a multinomial logistic regression.

    Args:
        without: logits ``[S, N, A]`` that are there without it.
        features: ``[S, N, R]``.
        counts: ``[N, A]``.
        scale: standard deviation of the weights' prior.
    """
    weights, precision = [], []
    for some in torch.arange(len(features)).split(DRAWS):
        best, curvature = _mode(without[some], features[some], counts, scale)
        weights.append(best)
        precision.append((curvature + curvature.mT) / 2)  # else symmetric but for rounding
    return MultivariateNormal(torch.cat(weights), precision_matrix=torch.cat(precision))


def _mode(
    without: Tensor, features: Tensor, counts: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor]:
    """The best weights ``[S, R A]`` by Newton's method, and the precision there."""
    number, _, size = features.shape
    actions = without.shape[-1]
    # Moments last: operations along few actions are much quicker in front of them than behind.
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
    """The unordered pair that each ``[size, size]`` is, in the order of the upper triangle."""
    first, second = torch.triu_indices(size, size)
    which = torch.zeros(size, size, dtype=torch.long)
    which[first, second] = which[second, first] = torch.arange(len(first))
    return which

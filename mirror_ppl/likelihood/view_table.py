"""Tables of views: every distinct way in which a person may have seen their rounds.

Perceptual implants affect the likelihood only through percepts, which alone determine beliefs. Many
combinations of implants have the same view of a round, so beliefs are computed once for each
distinct view; the program then looks up the view that its implants lead to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import pad

from mirror_ppl.likelihood.attention import AttentionValues
from mirror_ppl.likelihood.chain import Chain
from mirror_ppl.likelihood.densities import log_weighted_latents
from mirror_ppl.likelihood.grid import Grid
from mirror_ppl.likelihood.sums import Sums
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.shapes import broadcast_shapes

NO_VIEW = -1
"""Index of a combination of implants that was dropped."""
IMPOSSIBLE = -1e6
"""Log-likelihood in nats of such a combination; finite, so that gradients are finite."""


@dataclass(frozen=True)
class Attention:
    """G weighted values of the round latents of each round, to sum them out approximately.

    A combination of a person's implants then has one view of a round for each of these values.
    These views together are a *sight* of the round; there are U.

    Attributes:
        values: values of the sites of ``round_latents``, ``[P, B, G]``.
        log_weights: log inverse inclusion probability of each value, ``[P, B, G]``; minus infinity
            in padding.
        kept: the values that explain the actions, ``[P, B, G']``, an index into the G.
        log_kept: log-probability with which each of these was kept, ``[P, B, G']``; infinity in
            padding.
        sights: the view of each sight under each value kept, ``[P, U, G']``, an index into the V
            views.
        rounds: round of each sight, ``[P, U]``.
        covariates: covariates of the rounds ``[P, B]``, see `HumanModel.covariates`.
    """

    values: Mapping[str, Tensor]
    log_weights: Tensor
    kept: Tensor
    log_kept: Tensor
    sights: Tensor
    rounds: Tensor
    covariates: Mapping[str, Tensor] = field(default_factory=dict)

    @classmethod
    def of_rounds(cls, attended: Sequence[AttentionValues], sights: Sequence[Tensor]) -> Attention:
        """Join the attention of one person's rounds, given the sights of each ``[U, G']``."""
        most = max(part.shape[1] for part in sights)
        device = sights[0].device
        rounds = [
            torch.full((len(part),), place, device=device) for place, part in enumerate(sights)
        ]
        return cls(
            values={
                name: _stacked([one.values[name] for one in attended])
                for name in attended[0].values
            },
            log_weights=_stacked([one.log_weights for one in attended], -torch.inf),
            kept=_stacked([one.kept for one in attended]),
            log_kept=_stacked([one.log_kept for one in attended], torch.inf),
            sights=torch.cat([pad(part, [0, most - part.shape[1]]) for part in sights])[None],
            rounds=torch.cat(rounds)[None],
            covariates={
                name: torch.cat([one.covariates[name] for one in attended], 1)
                for name in attended[0].covariates
            },
        )

    def log_probabilities(self, human: HumanModel, implants: Implants, rounds: int) -> Tensor:
        """Weighted log-probabilities of the values ``[..., P, B, G]``, inside the person plate."""
        del rounds
        return log_weighted_latents(human, implants, self.values, self.log_weights, self.covariates)

    def marginal(self, likelihoods: Tensor, log_weights: Tensor) -> Tensor:
        """Log-likelihood ``[..., P, U]`` of sights, given that of views ``[..., P, V]``.

        Args:
            likelihoods: log-likelihood of the recorded actions under each view.
            log_weights: weights of values, see :meth:`log_probabilities`, ``[..., P, B, G]``.
        """
        shape = self.sights.shape[1:]
        views = self.sights.flatten(1).expand(*likelihoods.shape[:-1], -1)
        found = likelihoods.gather(-1, views).unflatten(-1, shape)
        shares = self.shares(log_weights)
        rounds = self.rounds[..., None].expand(*shares.shape[:-2], *shape)
        return torch.logsumexp(found + shares.gather(-2, rounds), -1)

    def shares(self, log_weights: Tensor) -> Tensor:
        """Log weights ``[..., P, B, G']`` of the kept values, given those of all values."""
        kept = self.kept.expand(*log_weights.shape[:-1], -1)
        return log_weights.gather(-1, kept) - self.log_kept


@dataclass(frozen=True)
class ViewTable:
    """Distinct views of the rounds of P people, V a person (padded), with the beliefs they lead to.

    Views share the N moments that they have in common.

    Attributes:
        grid: the M joint values of the sites that views depend on; points are of one person.
        index: sight of each person, round and joint value, ``[P, B, M]``, an index into the
            person's U sights or ``NO_VIEW``. Without round latents a sight is a view, and U is V.
        moments: number of the moment at each step of a view, ``[P, V, T]``; ``NO_VIEW`` in
            padding.
        belief: ``[P, N, Z]``.
        values: the self-model's action values ``[P, N, A]``.
        acted: the recorded action there, ``[P, N]``.
        recorded: actions ``[P, B, T]``, 0 in padding.
        steps: False in padding ``[P, B, T]``.
        view_counts: number of views of each person ``[P]``, without padding.
        attention: round latents, if the model has any: sampled values, or a chain that is summed
            out exactly. Views of a chain are of spans: their moments outside of these are
            ``NO_VIEW``.
        likely: values ``[S, 1, 1, ...]`` of other sites under which one person's rounds are
            probable (of a table of several people, none).
    """

    grid: Grid
    index: Tensor
    moments: Tensor
    belief: Tensor
    values: Tensor
    acted: Tensor
    recorded: Tensor
    steps: Tensor
    view_counts: Tensor
    attention: Attention | Chain | None = None
    likely: dict[str, Tensor] = field(default_factory=dict)

    @cached_property
    def _steps_of_views(self) -> Sums:
        return Sums.of(self.moments, self.moments != NO_VIEW, self.acted.shape[-1])

    @property
    def sites(self) -> tuple[str, ...]:
        """Names of the sites that views depend on."""
        return tuple(self.grid)

    @property
    def sizes(self) -> tuple[int, ...] | None:
        """Number of values of each of these; None for points."""
        return self.grid.sizes

    @property
    def people(self) -> int:
        """Number of people P."""
        return self.recorded.shape[0]

    @property
    def rounds(self) -> int:
        """Largest number of rounds B of a person."""
        return self.recorded.shape[1]

    @property
    def real(self) -> Tensor:
        """Mask of the rounds that are not padding, ``[P, B]``."""
        return self.steps.any(-1)

    def sight_of(self, implants: Implants) -> Tensor:
        """Sight in each round ``[..., P, B]`` under implants ``[..., P, 1]``."""
        people = torch.arange(self.people, device=self.index.device)[:, None]
        rounds = torch.arange(self.rounds, device=self.index.device)
        begin = (people * self.rounds + rounds) * self.index.shape[-1]
        return self.index.reshape(-1)[begin + self.combination(implants)]

    @cached_property
    def possible(self) -> Tensor:
        """Mask of the combinations that were never dropped, ``[P, M]``."""
        return ((self.index != NO_VIEW) | ~self.real[..., None]).all(1)

    @cached_property
    def _places(self) -> Tensor:
        """Index of each combination among a person's possible ones, ``[P, M]``."""
        return torch.where(self.possible, self.possible.cumsum(1) - 1, NO_VIEW)

    @cached_property
    def possible_numbers(self) -> Tensor:
        """Numbers of the possible combinations of each person, ``[C, P]``.

        Padded with impossible ones, whose likelihood is almost 0.
        """
        number = int(self.possible.sum(1).max())
        first = self.possible.long().argsort(dim=1, descending=True, stable=True)
        return first[:, :number].T

    @cached_property
    def _sights(self) -> Tensor:
        """Sights of the C possible combinations in each round, ``[P, B, C]``; 0 in padding."""
        numbers = self.possible_numbers.T[:, None].expand(-1, self.rounds, -1)
        return self.index.gather(-1, numbers).clamp(min=0)

    def place_of(self, implants: Implants) -> Tensor:
        """Index of implants ``[..., P, 1]`` among the possible combinations, ``[..., P, 1]``."""
        people = torch.arange(self.people, device=self.index.device)[:, None]
        begin = people * self.index.shape[-1]
        return self._places.reshape(-1)[begin + self.combination(implants)]

    def scores(self, likelihoods: Tensor) -> Tensor:
        """Log-likelihood ``[..., P, C]`` of combinations, given that of sights ``[..., P, U]``."""
        sights = self._sights.flatten(1).expand(*likelihoods.shape[:-1], -1)
        found = likelihoods.gather(-1, sights).unflatten(-1, self._sights.shape[1:])
        return torch.where(self.real[..., None], found, 0.0).sum(-2)

    def combination(self, implants: Implants) -> Tensor:
        """Number of the joint value of implants ``[...]``."""
        return self.grid.place_of(implants)

    def along_views(self, moments: Tensor) -> Tensor:
        """Log-likelihood ``[..., P, V]`` of views, given that of moments ``[..., P, N]``."""
        return self._steps_of_views(moments)


class RecordedActions(TorchDistribution):
    """Distribution of a person's actions ``[B, T]`` with precomputed log-likelihoods.

    Args:
        log_likelihoods: those of the actions under each possible combination ``[..., P, C]``.
        place: index of the person's combination ``[..., P, 1]``; ``NO_VIEW`` if impossible.
        shape: (B, T).
    """

    arg_constraints = {}  # noqa: RUF012 # pyright: ignore[reportAssignmentType]
    support = constraints.independent(  # pyright: ignore[reportAssignmentType]
        constraints.nonnegative_integer, 2
    )

    def __init__(self, log_likelihoods: Tensor, place: Tensor, shape: torch.Size) -> None:
        self.log_likelihoods = log_likelihoods
        self.place = place
        batch = broadcast_shapes((*log_likelihoods.shape[:-1], 1), place.shape)
        super().__init__(batch, shape, validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        """Look up the log-likelihood; ``value`` has to be the recorded actions, and is ignored."""
        del value
        number = self.log_likelihoods.shape[-1]
        # Offset of each leading index in the flat table; gathering from a flat table keeps the
        # gradient as small as the table.
        begin = torch.arange(
            self.log_likelihoods[..., 0].numel(), device=self.place.device
        ).reshape(*self.log_likelihoods.shape[:-1], 1)
        found = self.log_likelihoods.reshape(-1)[begin * number + self.place.clamp(min=0)]
        return torch.where(self.place == NO_VIEW, IMPOSSIBLE, found)


def _stacked(parts: Sequence[Tensor], fill: float = 0) -> Tensor:
    """Values ``[...]`` of each round as ``[1, B, ...]``, padded at the end."""
    most = max(len(part) for part in parts)
    return torch.stack([pad(part, [0, most - len(part)], value=fill) for part in parts])[None]

"""Exact marginalization of attention that is read span by span.

Where each site of ``round_latents`` is read at certain steps only (its
:class:`~mirror_ppl.models.spans.Span`), attention
need not be enumerated combination by combination. The values read so far matter only through the
belief and the knowledge that they led to, and many values lead to the same. The sum therefore runs
backwards through the round, over the *states* in which a span may begin::

    L_i(h) = sum_m p(m_i = m | psi) prod_{t in span i} p(a_t | zH_t(h, m)) L_{i+1}(h'(h, m))

where ``h'`` is the state in which the next span begins. This is the forward-backward recursion of
hidden Markov models (Rabiner, *A tutorial on hidden Markov models*, 1989), with spans as steps.

Dimensions: P people, B rounds, S states, K values, V views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.densities import log_latents
from mirror_ppl.models.human import HumanModel, Implants

NO_VALUE = -1
"""Index of a value in padding."""
NEVER = -1e30
"""Log-probability that stands for 0; finite, so that gradients are finite."""


@dataclass(frozen=True)
class Level:
    """Transitions at the span of one site: from each state, by each value.

    Attributes:
        view: view of the span's steps, ``[P, S, K]``, an index into the V views.
        value: the value that leads to it, an index into the site's :meth:`Chain.log_probabilities`,
            ``[P, S, K]``; ``NO_VALUE`` in padding.
        following: state in which the next span begins ``[P, S, K]``; unused at the last span.
        rounds: round of each state ``[P, S]``; ``NO_VALUE`` in padding.
    """

    view: Tensor
    value: Tensor
    following: Tensor
    rounds: Tensor

    def at(self, states: Tensor) -> Level:
        """Select states ``[s]``."""
        return Level(*(part[:, states] for part in vars(self).values()))


@dataclass(frozen=True)
class Chain:
    """Attention of people in their rounds, as a chain of spans.

    A combination of a person's implants has one *sight* of a round: a state of the first level.

    Attributes:
        supports: supports of the sites of ``round_latents``, ``[n]``, in the order of their spans.
        levels: one level for each site.
        covariates: covariates of the rounds ``[P, B]``, see `HumanModel.covariates`.
    """

    supports: Mapping[str, Tensor]
    levels: tuple[Level, ...]
    covariates: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def sights(self) -> int:
        """Number of sights U, padding included."""
        return self.levels[0].view.shape[1]

    def log_probabilities(self, human: HumanModel, implants: Implants, rounds: int) -> Tensor:
        """Log-probabilities of values ``[..., P, B, I, 2 n]`` of the I sites.

        First of each value, then of it or any later one. Runs inside the person plate.

        Args:
            human: the model of people.
            implants: as :meth:`HumanModel.prior` returned them, ``[..., P, 1]``.
            rounds: number of rounds B.
        """
        people = self.levels[0].view.shape[0]
        most = max(len(support) for support in self.supports.values())
        # Shorter supports are padded with their last value, which is then dropped.
        values = {
            name: torch.cat([support, support[-1:].expand(most - len(support))]).expand(
                people, rounds, most
            )
            for name, support in self.supports.items()
        }
        found = log_latents(human, implants, values, self.covariates)
        parts = []
        added = found.pop(next(iter(self.supports)))
        for name in set(found) - set(self.supports):
            if found[name].shape[-1] > 1:
                raise HumanModelError(
                    f'"{name}" of round_latents depends on sites that are summed out span after '
                    "span; without spans it can be inferred"
                )
            added = added + found[name]
        found[next(iter(self.supports))] = added
        for name, support in self.supports.items():
            own = pad(found[name][..., : len(support)], [0, most - len(support)], value=NEVER)
            later = own.flip(-1).logcumsumexp(-1).flip(-1)
            parts.append(torch.cat([own, later], -1))
        return torch.stack(torch.broadcast_tensors(*parts), -2)

    def marginal(self, likelihoods: Tensor, log_probabilities: Tensor) -> Tensor:
        """Log-likelihood ``[..., P, U]`` of sights, given that of views ``[..., P, V]``.

        Args:
            likelihoods: log-likelihood of the recorded actions under each view.
            log_probabilities: see :meth:`log_probabilities`.
        """
        after = None
        for number, level in reversed(list(enumerate(self.levels))):
            score = _taken(likelihoods, level.view) + self.of_level(log_probabilities, number)
            if after is not None:
                score = score + _taken(after, level.following)
            score = torch.where(level.value == NO_VALUE, NEVER, score)
            after = _log_sum_exp(score)
        assert after is not None
        return after

    def of_level(self, log_probabilities: Tensor, number: int) -> Tensor:
        """Return log-probabilities ``[..., P, S, K]`` of one level's values.

        Args:
            log_probabilities: those of all levels (:meth:`log_probabilities`).
            number: of the level.
        """
        level, own = self.levels[number], log_probabilities[..., number, :]
        place = level.rounds[..., None].clamp(min=0) * own.shape[-1] + level.value.clamp(min=0)
        return _taken(own.flatten(-2), place)

    def kept(self, sights: Tensor) -> tuple[Chain, Tensor]:
        """Select sights ``[u]`` of one person; also returns the views ``[v]`` that they lead to."""
        levels, states = [], sights
        for level in self.levels:
            own = level.at(states)
            states, following = _renumbered(own.following, own.value != NO_VALUE)
            levels.append(replace(own, following=following))
        everywhere = torch.cat([level.view[level.value != NO_VALUE] for level in levels])
        views = everywhere.unique()
        place = views.new_zeros(int(views.max()) + 1)
        place[views] = torch.arange(len(views), device=views.device)
        return replace(self, levels=tuple(levels)).of_views(place), views

    def of_views(self, place: Tensor) -> Chain:
        """Renumber views: v becomes ``place[v]``."""
        levels = tuple(
            replace(
                one, view=place[torch.where(one.value == NO_VALUE, one.view[0, 0, 0], one.view)]
            )
            for one in self.levels
        )
        return replace(self, levels=levels)

    def of_person(self, person: int) -> Chain:
        """Select one of the P people."""
        levels = tuple(
            Level(*(part[person : person + 1] for part in vars(level).values()))
            for level in self.levels
        )
        covariates = {name: value[person : person + 1] for name, value in self.covariates.items()}
        return Chain(self.supports, levels, covariates)

    @classmethod
    def one_after_another(cls, rounds: Sequence[Chain], views: Sequence[int]) -> Chain:
        """Concatenate the chains of one person's rounds, with ``views`` views each."""
        begins = [sum(views[:place]) for place in range(len(views))]
        levels = []
        for number in range(len(rounds[0].levels)):
            own = [chain.levels[number] for chain in rounds]
            behind = [
                chain.levels[number + 1].view.shape[1] if number + 1 < len(chain.levels) else 0
                for chain in rounds
            ]
            width = max(level.view.shape[-1] for level in own)
            parts = []
            for place, (level, begin) in enumerate(zip(own, begins, strict=True)):
                missing = [0, width - level.view.shape[-1]]
                parts.append(
                    (
                        pad(level.view + begin, missing, value=begin),
                        pad(level.value, missing, value=NO_VALUE),
                        pad(level.following + sum(behind[:place]), missing),
                        torch.full_like(level.rounds, place),
                    )
                )
            levels.append(Level(*(torch.cat(some, 1) for some in zip(*parts, strict=True))))
        covariates = {
            name: torch.cat([chain.covariates[name] for chain in rounds], 1)
            for name in rounds[0].covariates
        }
        return cls(rounds[0].supports, tuple(levels), covariates)

    @classmethod
    def of_people(cls, people: Sequence[Chain]) -> Chain:
        """Stack the chains of P people, whose covariates have the same number of rounds."""
        levels = []
        for own in zip(*(chain.levels for chain in people), strict=True):
            states = max(level.view.shape[1] for level in own)
            width = max(level.view.shape[2] for level in own)
            levels.append(
                Level(
                    _padded([level.view for level in own], states, width, 0),
                    _padded([level.value for level in own], states, width, NO_VALUE),
                    _padded([level.following for level in own], states, width, 0),
                    _padded([level.rounds[..., None] for level in own], states, 1, NO_VALUE)[
                        ..., 0
                    ],
                )
            )
        covariates = {
            name: torch.cat([chain.covariates[name] for chain in people])
            for name in people[0].covariates
        }
        return cls(people[0].supports, tuple(levels), covariates)


def _padded(parts: Sequence[Tensor], states: int, width: int, fill: int) -> Tensor:
    """Pad and stack parts ``[1, s, k]`` of P people to ``[P, states, width]``."""
    return torch.cat(
        [
            pad(part, [0, width - part.shape[2], 0, states - part.shape[1]], value=fill)
            for part in parts
        ]
    )


def _log_sum_exp(values: Tensor) -> Tensor:
    """`torch.logsumexp` over the last dimension, in a third of the time if most is padding.

    Terms below e**-80 of the largest are raised to that, because exponentials that underflow are
    slow.
    """
    highest = values.amax(-1, keepdim=True).detach()
    return (values - highest).clamp(min=-80.0).exp().sum(-1).log() + highest.squeeze(-1)


def _taken(values: Tensor, place: Tensor) -> Tensor:
    """Gather values ``[..., P, n]`` at indices ``[P, S, K]``: ``[..., P, S, K]``."""
    found = values.gather(-1, place.flatten(-2).expand(*values.shape[:-1], -1))
    return found.unflatten(-1, place.shape[-2:])


def _renumbered(following: Tensor, real: Tensor) -> tuple[Tensor, Tensor]:
    """Reached states ``[s]``, and ``following`` as indices into them."""
    states = following[real].unique()
    place = states.new_zeros(int(following.max()) + 1)
    place[states] = torch.arange(len(states), device=states.device)
    return states, torch.where(real, place[following], 0)

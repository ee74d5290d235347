"""Exact marginalization of attention that is read span by span.

Where each site of ``round_latents`` is read at certain steps only (its
:class:`~mirror_ppl.models.spans.Span`), attention need not be enumerated combination by
combination. The values read so far matter only through the belief and the knowledge that they led
to, and many values lead to the same. The sum therefore runs backwards through the round, over the
*states* in which a span may begin::

    L_i(h) = sum_m p(m_i = m | psi) prod_{t in span i} p(a_t | zH_t(h, m)) L_{i+1}(h'(h, m))

where ``h'`` is the state in which the next span begins. This is the forward-backward recursion of
hidden Markov models (Rabiner, *A tutorial on hidden Markov models*, 1989), with spans as steps.

At a span a person goes from a *state* by a value to the next state; such a *course* has a view of
the span's steps.

Dimensions: P people, B rounds, S states, E courses, V views, D draws.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.densities import log_latents
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.shapes import broadcast_shapes

NEVER = -1e30
"""Log-probability that stands for 0; finite, so that gradients are finite."""
LEAST = 1e-300
"""Least probability of a value and all later ones, relative to the most probable value."""


@dataclass(frozen=True)
class Level:
    """Courses through the span of one site.

    States are numbered person by person, courses state by state.

    Attributes:
        state: state in which the span begins ``[E]``, in order.
        value: the value, an index into the site's :meth:`Chain.log_probabilities`, ``[E]``.
        view: view of the span's steps ``[E]``, an index into the person's V views.
        following: state in which the next span begins ``[E]``; unused at the last span.
        person: person of each state ``[S]``, in order.
        rounds: round of each state ``[S]``.
    """

    state: Tensor
    value: Tensor
    view: Tensor
    following: Tensor
    person: Tensor
    rounds: Tensor

    def selected(self, states: Tensor) -> tuple[Level, Tensor]:
        """Select states ``[s]``, in order; also returns the states ``[s']`` that they lead to."""
        place = _places(states, len(self.person))
        own = place[self.state] >= 0
        reached, following = self.following[own].unique(return_inverse=True)
        level = Level(
            place[self.state[own]],
            self.value[own],
            self.view[own],
            following,
            self.person[states],
            self.rounds[states],
        )
        return level, reached


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

    @cached_property
    def people(self) -> int:
        """Number of people P."""
        return int(self.levels[0].person[-1]) + 1

    @cached_property
    def sights(self) -> int:
        """Number of sights U of the person with most."""
        return int(torch.bincount(self.levels[0].person).max())

    @cached_property
    def places(self) -> Tensor:
        """Place of each state of the first level among the ``P * U`` sights, ``[S]``."""
        person = self.levels[0].person
        begin = torch.searchsorted(person, person)
        return person * self.sights + torch.arange(len(person), device=person.device) - begin

    def log_probabilities(self, human: HumanModel, implants: Implants, rounds: int) -> Tensor:
        """Log-probabilities of values ``[..., P, B, I, 2 n]`` of the I sites.

        First of each value, then of it or any later one. Runs inside the person plate.

        Args:
            human: the model of people.
            implants: as :meth:`HumanModel.prior` returned them, ``[..., P, 1]``.
            rounds: number of rounds B.
        """
        most = max(len(support) for support in self.supports.values())
        # Shorter supports are padded with their last value, which is then dropped.
        values = {
            name: torch.cat([support, support[-1:].expand(most - len(support))]).expand(
                self.people, rounds, most
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
            parts.append(torch.cat([own, _later(own)], -1))
        return torch.stack(torch.broadcast_tensors(*parts), -2)

    def marginal(self, likelihoods: Tensor, log_probabilities: Tensor) -> Tensor:
        """Log-likelihood ``[..., P, U]`` of sights, given that of views ``[..., P, V]``.

        Args:
            likelihoods: log-likelihood of the recorded actions under each view.
            log_probabilities: see :meth:`log_probabilities`.
        """
        lead = broadcast_shapes(likelihoods.shape[:-2], log_probabilities.shape[:-4])
        people, views = likelihoods.shape[-2:]
        probabilities = draws_last(log_probabilities, lead, 4)
        likelihood = draws_last(likelihoods, lead, 2).flatten(0, 1)
        after = None
        for number, level in reversed(list(enumerate(self.levels))):
            view = level.person[level.state] * views + level.view
            score = likelihood.index_select(0, view) + self.of_level(probabilities, number)
            if after is not None:
                score = score + after.index_select(0, level.following)
            after = log_sums(score, level.state, len(level.person))
        assert after is not None
        found = after.new_full((people * self.sights, after.shape[-1]), NEVER)
        found = found.index_copy(0, self.places, after)
        return found.T.reshape(*lead, people, -1).contiguous()

    def of_level(self, probabilities: Tensor, number: int) -> Tensor:
        """Return the log-probability ``[E, D]`` of the value of each course of one level.

        Args:
            probabilities: :meth:`log_probabilities` of all levels, draws last
                ``[P, B, I, 2 n, D]``.
            number: of the level.
        """
        level, (people, rounds, _, values, _) = self.levels[number], probabilities.shape
        place = ((level.person * rounds + level.rounds) * values)[level.state] + level.value
        own = probabilities[:, :, number].reshape(people * rounds * values, -1)
        return own.index_select(0, place)

    def kept(self, sights: Tensor) -> tuple[Chain, Tensor]:
        """Select sights ``[u]`` of one person, in order; also returns their views ``[v]``."""
        chain = self._selected(sights)
        views = torch.cat([level.view for level in chain.levels]).unique()
        return chain.of_views(_places(views, int(views[-1]) + 1)), views

    def _selected(self, sights: Tensor) -> Chain:
        levels, states = [], sights
        for level in self.levels:
            own, states = level.selected(states)
            levels.append(own)
        return replace(self, levels=tuple(levels))

    def of_views(self, place: Tensor) -> Chain:
        """Renumber views: v becomes ``place[v]``."""
        return replace(
            self, levels=tuple(replace(one, view=place[one.view]) for one in self.levels)
        )

    def of_person(self, person: int) -> Chain:
        """Select one of the P people."""
        (own,) = (self.levels[0].person == person).nonzero(as_tuple=True)
        alone = self._selected(own)
        levels = tuple(replace(one, person=torch.zeros_like(one.person)) for one in alone.levels)
        covariates = {name: value[person : person + 1] for name, value in self.covariates.items()}
        return Chain(self.supports, levels, covariates)

    @classmethod
    def one_after_another(cls, rounds: Sequence[Chain], views: Sequence[int]) -> Chain:
        """Concatenate the chains of one person's rounds, with ``views`` views each."""
        numbered = []
        for place, chain in enumerate(rounds):
            levels = tuple(
                replace(
                    one,
                    view=one.view + sum(views[:place]),
                    rounds=torch.full_like(one.rounds, place),
                )
                for one in chain.levels
            )
            numbered.append(replace(chain, levels=levels))
        return _joined(numbered, 1)

    @classmethod
    def of_people(cls, people: Sequence[Chain]) -> Chain:
        """Stack the chains of P people, whose covariates have the same number of rounds."""
        numbered = []
        for place, chain in enumerate(people):
            levels = tuple(
                replace(one, person=torch.full_like(one.person, place)) for one in chain.levels
            )
            numbered.append(replace(chain, levels=levels))
        return _joined(numbered, 0)


def _joined(chains: Sequence[Chain], axis: int) -> Chain:
    """Concatenate chains, whose covariates are joined along an axis."""
    levels = []
    for number, own in enumerate(zip(*(chain.levels for chain in chains), strict=True)):
        last = number + 1 == len(chains[0].levels)
        states = [len(level.person) for level in own]
        behind = [0 if last else len(chain.levels[number + 1].person) for chain in chains]
        parts = [
            replace(
                level,
                state=level.state + sum(states[:place]),
                following=level.following + sum(behind[:place]),
            )
            for place, level in enumerate(own)
        ]
        levels.append(
            Level(
                *(
                    torch.cat(some)
                    for some in zip(*(vars(one).values() for one in parts), strict=True)
                )
            )
        )
    covariates = {
        name: torch.cat([chain.covariates[name] for chain in chains], axis)
        for name in chains[0].covariates
    }
    return Chain(chains[0].supports, tuple(levels), covariates)


def draws_last(values: Tensor, lead: Sequence[int], own: int) -> Tensor:
    """Values ``[..., *own]`` with leading dimensions ``lead`` as one, the last: ``[*own, D]``."""
    shape = values.shape[values.dim() - own :]
    return values.expand(*lead, *shape).reshape(-1, *shape).movedim(0, -1).contiguous()


def log_sums(values: Tensor, groups: Tensor, number: int) -> Tensor:
    """Log of the sums of exponentials ``[number, D]`` of values ``[E, D]`` in groups ``[E]``."""
    highest = _highest(values, groups, number)
    return scaled_sums(values, groups, groups, number, highest).log() + highest


def scaled_sums(
    values: Tensor, groups: Tensor, parts: Tensor, number: int, highest: Tensor | None = None
) -> Tensor:
    """Sums of exponentials ``[number, D]`` of values ``[E, D]`` in parts ``[E]`` of groups ``[E]``.

    There are ``number`` parts, each of one group; sums are relative to the largest exponential of
    that group, whose logarithm is computed unless given. Terms below e**-80 of it are raised to
    that, because exponentials that underflow are slow.
    """
    if highest is None:
        highest = _highest(values, groups, int(groups.max()) + 1)
    scaled = (values - highest.index_select(0, groups)).clamp(min=-80.0).exp()
    return values.new_zeros(number, values.shape[-1]).index_add(0, parts, scaled)


def _highest(values: Tensor, groups: Tensor, number: int) -> Tensor:
    """Largest of values ``[E, D]`` in each group, ``[number, D]``."""
    highest = values.new_full((number, values.shape[-1]), NEVER)
    return highest.scatter_reduce_(0, groups[:, None].expand_as(values), values.detach(), "amax")


def _later(values: Tensor) -> Tensor:
    """Log-probability of each of the values ``[..., n]`` or any later one.

    In 64 bits and not by `torch.logcumsumexp`, which takes ten times as long.
    """
    wide = values.double()
    highest = wide.amax(-1, keepdim=True).detach().clamp(min=NEVER)
    total = (wide - highest).exp().flip(-1).cumsum(-1).flip(-1)
    return (total.clamp(min=LEAST).log() + highest).to(values.dtype)


def _places(chosen: Tensor, number: int) -> Tensor:
    """Place of each of ``number`` things among those chosen ``[n]``; -1 of others."""
    place = chosen.new_full((number,), -1)
    place[chosen] = torch.arange(len(chosen), device=chosen.device)
    return place

"""Distinct views of rounds, and the moments that they consist of."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from mirror_ppl.domains import Observation, Visibility
from mirror_ppl.likelihood.chain import Chain
from mirror_ppl.likelihood.combinations import unread_sites
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models.belief_tracking import CHUNK, BeliefState, Memory, Transition
from mirror_ppl.models.handlers import WithoutSites
from mirror_ppl.models.human import HumanModel, at_step, messages_at
from mirror_ppl.models.sites import OnlyRead
from mirror_ppl.row_hashing import distinct_rows


@dataclass(frozen=True)
class Rounds:
    """R recorded rounds of one person.

    Attributes:
        observation: ``[R, T, ...]``.
        told: communicated items, ``[R, T, K]``.
        actions: ``[R, T]``; arbitrary in padding.
        real: False in padding, which is at the end, ``[R, T]``.
    """

    observation: Observation
    told: Visibility
    actions: Tensor
    real: Tensor

    def __len__(self) -> int:
        """The number of rounds R."""
        return len(self.actions)

    def at(self, first: int, last: int) -> Rounds:
        """Select rounds ``first`` to ``last`` (exclusive)."""
        return self.chosen(slice(first, last))

    def chosen(self, some: slice | list[int]) -> Rounds:
        """Select some rounds, in this order."""
        return Rounds(
            {name: value[some] for name, value in self.observation.items()},
            {name: mask[some] for name, mask in self.told.items()},
            self.actions[some],
            self.real[some],
        )

    def each(self) -> Iterator[Rounds]:
        """Iterate over the rounds."""
        return (self.at(number, number + 1) for number in range(len(self)))

    @classmethod
    def joined(cls, parts: Sequence[Rounds]) -> Rounds:
        """Concatenate rounds with equal numbers of steps."""
        return cls(
            {
                name: torch.cat([one.observation[name] for one in parts])
                for name in parts[0].observation
            },
            {name: torch.cat([one.told[name] for one in parts]) for name in parts[0].told},
            torch.cat([one.actions for one in parts]),
            torch.cat([one.real for one in parts]),
        )

    @property
    def steps(self) -> list[int]:
        """Number of steps of each round, without padding."""
        return self.real.sum(-1).tolist()

    def so_far(self, number: int) -> tuple[Observation, Tensor]:
        """Observations ``[t, ...]`` and actions ``[t]`` of one round, without padding."""
        real = self.real[number]
        observation = {name: value[number, real] for name, value in self.observation.items()}
        return observation, self.actions[number, real]


@dataclass(frozen=True)
class RoundViews:
    """V distinct views of one round, and their N moments; see
    :class:`~mirror_ppl.likelihood.view_table.ViewTable`.

    Attributes:
        moments: ``[V, T]``.
        belief: ``[N, Z]``.
        values: ``[N, A]``.
        acted: ``[N]``.
        sights: the view under each value of attention, ``[U, G]``; ``None`` if a sight is a view.
        rounds: round of each sight ``[U]``, if there is more than one round.
        chain: one person's attention, if it is summed out exactly; views are then of its spans.
    """

    moments: Tensor
    belief: Tensor
    values: Tensor
    acted: Tensor
    sights: Tensor | None = None
    rounds: Tensor | None = None
    chain: Chain | None = None

    def __len__(self) -> int:
        """The number of sights U."""
        if self.chain is not None:
            return self.chain.sights
        return len(self.moments if self.sights is None else self.sights)

    def lengthened(self, steps: int) -> RoundViews:
        """Pad the views to ``steps`` steps."""
        more = steps - self.moments.shape[1]
        if not more:
            return self
        return replace(self, moments=pad(self.moments, [0, more], value=NO_VIEW))

    def kept(self, sights: Tensor) -> RoundViews:
        """Select sights, with their views and moments."""
        if self.chain is not None:
            chain, views = self.chain.kept(sights)
            return replace(replace(self, chain=None).kept(views), chain=chain)
        if self.sights is not None:
            views, place = torch.unique(self.sights[sights], return_inverse=True)
            rounds = None if self.rounds is None else self.rounds[sights]
            alone = replace(self, sights=None, rounds=None)
            return replace(alone.kept(views), sights=place, rounds=rounds)
        moments = self.moments[sights]
        real = moments != NO_VIEW
        used, place = torch.unique(moments[real], return_inverse=True)
        moments = moments.clone()
        moments[real] = place
        if not len(used):  # padding only; act() still needs an input
            used = used.new_zeros(1)
        return RoundViews(moments, self.belief[used], self.values[used], self.acted[used])


@dataclass(frozen=True)
class ManyViews:
    """Distinct views of R rounds, one round after the other.

    Attributes:
        moments: number of the moment at each step of the V views, ``[V, T]``.
        belief: ``[N, Z]``.
        values: ``[N, A]``.
        acted: ``[N]``.
        views: round of each view ``[V]``, in order.
        rounds: round of each moment ``[N]``, in order.
        number: number of rounds R.
    """

    moments: Tensor
    belief: Tensor
    values: Tensor
    acted: Tensor
    views: Tensor
    rounds: Tensor
    number: int

    def split(self) -> list[tuple[slice, RoundViews]]:
        """Split into rounds: the slice of each round's views, and these views."""
        views, moments = (_begins(part, self.number) for part in (self.views, self.rounds))
        found = []
        for number in range(self.number):
            own = slice(views[number], views[number + 1])
            some = slice(moments[number], moments[number + 1])
            named = self.moments[own]
            named = torch.where(named == NO_VIEW, NO_VIEW, named - moments[number])
            part = RoundViews(named, self.belief[some], self.values[some], self.acted[some])
            if not len(part.acted):  # padding only; act() still needs an input
                part = replace(
                    part,
                    belief=self.belief.new_zeros(1, self.belief.shape[-1]),
                    values=self.values.new_zeros(1, self.values.shape[-1]),
                    acted=self.acted.new_zeros(1),
                )
            found.append((own, part))
        return found


def _begins(groups: Tensor, number: int) -> list[int]:
    """First index of each group ``[number + 1]``, given the sorted group of each item ``[n]``."""
    edges = torch.arange(number + 1, device=groups.device)
    return torch.searchsorted(groups, edges).tolist()


def distinct_in_groups(rows: Tensor, groups: Tensor) -> tuple[Tensor, Tensor]:
    """`distinct_rows` within groups ``[n]`` of rows ``[n, ...]``, ordered by group."""
    first, which = distinct_rows(torch.cat([groups[:, None], rows], 1))
    order = groups[first].argsort(stable=True)
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order), device=order.device)
    return first[order], place[which]


@torch.no_grad()
def views_of_rounds(
    human: HumanModel, implants: Mapping[str, Tensor], row: Tensor, rounds: Rounds
) -> tuple[ManyViews, Tensor]:
    """Distinct views of R rounds, and the view ``[n]`` of each combination of implants.

    Args:
        human: the model of people.
        implants: joint values ``[n, ...]`` of the sites that perception reads.
        row: the round that each combination sees ``[n]``.
        rounds: rounds of one person.
    """
    state = BeliefState.initial(human, len(row), Memory.of_rounds(human, rounds.observation))
    lengths = rounds.real.sum(-1)
    numbers = torch.full((len(row), rounds.actions.shape[1]), NO_VIEW, device=row.device)
    own, begin, under_way = row, 0, torch.arange(len(row), device=row.device)
    for end in lengths.unique().tolist():  # rows whose round is over are dropped
        going = lengths[own] >= end
        if not bool(going.all()):
            state, own, under_way = state.at(going), own[going], under_way[going]
            implants = {name: value[going] for name, value in implants.items()}
        state, found = moments_along(state, implants, rounds, own, range(begin, end))
        numbers[under_way, begin:end] = found[:, begin:end]
        begin = end
    return views_of_moments(state, numbers, row, len(rounds))


def moments_along(
    state: BeliefState,
    implants: Mapping[str, Tensor],
    rounds: Rounds,
    row: Tensor,
    steps: range,
) -> tuple[BeliefState, Tensor]:
    """Track beliefs through some steps of rounds; arguments as for :func:`views_of_rounds`.

    Returns:
        The state after these steps, and the number of the moment (belief and action) at each step,
        ``[n, T]``; ``NO_VIEW`` at other steps.
    """
    number, action_count = len(state.belief), len(state.human.domain.actions)
    moments = torch.full((number, rounds.actions.shape[1]), NO_VIEW, device=row.device)
    several, transitions = len(rounds) > 1, []
    implants = OnlyRead(implants, unread_sites(state.human))
    for step in steps:
        before = torch.full_like(row, action_count)
        if step:
            before = rounds.actions[row, step - 1]
        heard = messages_at(rounds.told, step)
        if several:
            heard = {name: mask[row] for name, mask in heard.items()}
        now = at_step(rounds.observation, step)
        transitions.append(Transition(implants, before, now, heard, row if several else None))
    states = state.through(transitions) if steps else []
    for step, now in zip(steps, states, strict=True):
        moments[:, step] = now.belief * action_count + rounds.actions[row, step]
    return [state, *states][-1], moments


def views_of_moments(
    state: BeliefState, numbers: Tensor, row: Tensor, number: int
) -> tuple[ManyViews, Tensor]:
    """Distinct views of rounds, and the view ``[n]`` of each row.

    Args:
        state: state whose moments are numbered, see :func:`moments_along`.
        numbers: numbers of moments ``[n, T]``.
        row: round of each row ``[n]``.
        number: number of rounds R.
    """
    human = state.human
    first, which = distinct_in_groups(numbers, row)
    moments, views = numbers[first], row[first]
    real = moments != NO_VIEW
    action_count = len(human.domain.actions)
    many = len(state.mean) * action_count
    used, place = (views[:, None] * many + moments)[real].unique(return_inverse=True)
    moments[real] = place
    rounds, moment = used // many, used % many
    some, belief = (moment // action_count).unique(return_inverse=True)
    with WithoutSites("action_values"):
        values = [human.action_values(part) for part in state.mean[some].split(CHUNK)]
    found = torch.cat(values)
    return (
        ManyViews(
            moments,
            state.mean[some][belief],
            found[belief],
            moment % action_count,
            views,
            rounds,
            number,
        ),
        which,
    )

"""Views of rounds span by span, for models that declare when each site of attention is read.

A history of attention matters only through the belief, the domain's knowledge, and the values that
are read throughout the round. Histories that agree in these are one state
(:mod:`mirror_ppl.likelihood.chain`). Rounds are processed together, step by step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from mirror_ppl.domains.base import map_state
from mirror_ppl.likelihood.attention import attention_sites
from mirror_ppl.likelihood.chain import Chain, Level
from mirror_ppl.likelihood.round_views import ManyViews, Rounds, moments_along, views_of_moments
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models.belief_tracking import BeliefState, Memory
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.spans import Span, check_spans
from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows


@torch.no_grad()
def chained_views(
    human: HumanModel, combinations: Mapping[str, Tensor], number: int, rounds: Rounds
) -> tuple[ManyViews, list[Chain]]:
    """Compute the distinct views of R rounds, and for each round a chain with M sights.

    Args:
        human: the model of people; its attention is :attr:`HumanModel.chained`.
        combinations: values ``[M, ...]`` of the sites of ``prior`` that perception reads.
        number: number of combinations M.
        rounds: rounds of one person.

    Returns:
        The views, and chains; these index views within their round.

    Raises:
        HumanModelError: ``spans`` breaks its contract.
    """
    supports = attention_sites(human)
    state = BeliefState.initial(human, number, Memory.of_rounds(human, rounds.observation))
    ways = []
    for place, steps in enumerate(rounds.steps):
        so_far, _ = rounds.so_far(place)
        spans = human.spans(so_far)
        check_spans(spans, {site: len(support) for site, support in supports.items()}, steps)
        facts = {name: fact.view(1, 1) for name, fact in human.covariates(so_far).items()}
        ways.append(_RoundWays(place, supports, combinations, spans, steps, facts, state))
    step = 0
    while True:
        for own in ways:
            own.go_on(step)
        going = [own for own in ways if step < own.steps]
        if not going:
            break
        until = min(own.end for own in going)
        row = torch.cat([torch.full_like(own.combination, own.round) for own in going])
        state = replace(
            state,
            belief=torch.cat([own.belief for own in going]),
            knowledge=map_state(lambda *parts: torch.cat(parts), *(own.knowledge for own in going)),
            step=step,
        )
        implants = {
            name: torch.cat([own.implants[name] for own in going]) for name in going[0].implants
        }
        state, moments = moments_along(state, implants, rounds, row, range(step, until))
        begin = 0
        for own in going:
            some = slice(begin, begin + len(own.combination))
            own.take(state.at(some), moments[some], slice(step, until))
            begin = some.stop
        step = until
    numbers = [torch.cat(own.rows) for own in ways]
    row = torch.cat([torch.full_like(own[:, 0], place) for place, own in enumerate(numbers)])
    views, which = views_of_moments(state, torch.cat(numbers), row, len(rounds))
    first = torch.searchsorted(views.views, torch.arange(len(rounds), device=row.device))
    local = (which - first[row]).split([len(own) for own in numbers])
    return views, [own.chain.of_views(place) for own, place in zip(ways, local, strict=True)]


@dataclass
class _RoundWays:
    """All distinct histories of attention in one round, up to some step.

    Attributes:
        round: number of the round.
        supports: supports of the sites of attention ``[n]``.
        combinations: values ``[M, ...]`` of the sites of ``prior`` that perception reads.
        spans: spans of the sites of attention.
        steps: number of steps of the round.
        covariates: covariates of the round ``[1, 1]``.
        combination: combination of each of n histories, ``[n]``.
        belief: number of the belief of each history ``[n]``.
        knowledge: knowledge of each history ``[n]``.
        implants: the values that are read now, ``[n]``.
        throughout: those of them that are read throughout the round ``[n]``.
        moments: moments of the current span ``[n, T]``.
        rows: moments of earlier spans.
        levels: levels of earlier spans.
    """

    round: int
    supports: Mapping[str, Tensor]
    combinations: Mapping[str, Tensor]
    spans: Mapping[str, Span]
    steps: int
    covariates: Mapping[str, Tensor]
    start: BeliefState
    rows: list[Tensor] = field(default_factory=list)
    levels: list[Level] = field(default_factory=list)
    throughout: dict[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.belief, self.knowledge = self.start.belief, self.start.knowledge
        self.combination = torch.arange(len(self.belief), device=self.belief.device)
        self._begins = [0, *(span.first for span in list(self.spans.values())[1:]), self.steps]
        self._branch()

    @property
    def end(self) -> int:
        """End of the current span (exclusive)."""
        return self._begins[len(self.levels) + 1]

    @property
    def chain(self) -> Chain:
        """The chain of all spans, once the round is over."""
        return Chain(self.supports, tuple(self.levels), self.covariates)

    def go_on(self, step: int) -> None:
        """Advance to the span that begins at this step, if one does."""
        while len(self.levels) < len(self.spans) and self.end == step:
            self._merge()
            if len(self.levels) < len(self.spans):
                self._branch()

    def take(self, state: BeliefState, moments: Tensor, steps: slice) -> None:
        """Store the beliefs and moments of each history after some steps."""
        self.belief, self.knowledge = state.belief, state.knowledge
        self.moments[:, steps] = moments[:, steps]

    def _branch(self) -> None:
        """Begin a span: continue each history with each value of its site."""
        site, span = list(self.spans.items())[len(self.levels)]
        states = len(self.combination)
        parent = torch.arange(states, device=self.belief.device).repeat_interleave(span.values)
        self.combination, self.belief = self.combination[parent], self.belief[parent]
        self.knowledge = map_state(lambda part: part[parent], self.knowledge)
        self.throughout = {name: own[parent] for name, own in self.throughout.items()}
        # Sites of other spans are not read at this one: any value will do.
        values = {name: own[:1].expand(len(parent)) for name, own in self.supports.items()}
        values |= self.throughout
        values[site] = self.supports[site][: span.values].repeat(states)
        self.implants = {name: own[self.combination] for name, own in self.combinations.items()}
        self.implants |= values
        if span.last == self.steps and span.first == 0:
            self.throughout[site] = values[site]
        width = self.start.memory.observed.shape[1]  # pyright: ignore[reportOptionalMemberAccess]
        self.moments = torch.full((len(parent), width), NO_VIEW, device=parent.device)
        self._shape = (states, span.values)

    def _merge(self) -> None:
        """End the span: merge histories that lead to the same state."""
        device = self.belief.device
        others = [self.combination, *map(as_whole_numbers, self.throughout.values())]
        state = replace(self.start, belief=self.belief, knowledge=self.knowledge)
        key = torch.cat([torch.stack(others, -1), state.key()], -1)
        first, following = distinct_rows(key)
        index = torch.arange(self._shape[-1], device=device)
        index[-1] += max(len(own) for own in self.supports.values())  # that value or any later
        done = sum(map(len, self.rows))
        states, values = self._shape
        of_state = torch.zeros(states, dtype=torch.long, device=device)
        self.levels.append(
            Level(
                state=torch.arange(states, device=device).repeat_interleave(values),
                value=index.repeat(states),
                view=done + torch.arange(states * values, device=device),
                following=following,
                person=of_state,
                rounds=of_state,
            )
        )
        self.rows.append(self.moments)
        self.combination, self.belief = self.combination[first], self.belief[first]
        self.knowledge = map_state(lambda part: part[first], self.knowledge)
        self.throughout = {name: own[first] for name, own in self.throughout.items()}

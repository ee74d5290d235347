"""The views of a round span by span, where it is known when each site of attention is read.

A state is what is left of all that a person may have attended to so far: a belief, what the domain
says they know, and the values that are read throughout the round. States that are the same in that
are one (:mod:`mirror_ppl.likelihood.chain`). n stands for states with a value each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains import Observation, Visibility
from mirror_ppl.domains.base import map_state
from mirror_ppl.likelihood.attention import attention_sites
from mirror_ppl.likelihood.chain import Chain, Level
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.spans import check_spans
from mirror_ppl.models.view import View
from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows, random_keys


@dataclass(frozen=True)
class ChainedViews:
    """What a person may see in one round.

    Attributes:
        chain: of the round; a sight for each combination of implants.
        moments: of each view ``[V, T]``; ``NO_VIEW`` outside of its span.
        belief: at these N moments ``[N, Z]``.
        acted: what was done there ``[N]``.
    """

    chain: Chain
    moments: Tensor
    belief: Tensor
    acted: Tensor


@torch.no_grad()
def chained_views(  # noqa: PLR0913 - a round, and whose it is
    human: HumanModel,
    combinations: Mapping[str, Tensor],
    number: int,
    observation: Observation,
    told: Visibility,
    actions: Tensor,
    real: Tensor,
) -> ChainedViews:
    """Go through one round.

    Args:
        human: the model of people; its attention is :attr:`HumanModel.chained`.
        combinations: values ``[M]`` of the discrete implants.
        number: M.
        observation: ``[1, T, ...]``.
        told: ``[1, T, K]``.
        actions: ``[1, T]``.
        real: which steps are no padding, ``[T]``.

    Raises:
        HumanModelError: ``spans`` breaks its contract.
    """
    so_far = {name: value[0, real] for name, value in observation.items()}
    steps = int(real.sum())
    supports = attention_sites(human)
    spans = human.spans(so_far)
    check_spans(spans, {site: len(support) for site, support in supports.items()}, steps)
    facts = {name: fact.view(1, 1) for name, fact in human.covariates(so_far).items()}
    course = _Course(human, combinations, observation, told, actions[0])
    states = course.beginning(number)
    levels, rows = [], []
    begins = [0, *(span.first for span in list(spans.values())[1:]), steps]
    done = 0
    for place, (site, span) in enumerate(spans.items()):
        support, device = supports[site], actions.device
        # Sites of other spans are not read at this one: any value will do.
        some = {name: own[:1].expand(states.number) for name, own in supports.items()}
        some |= states.throughout
        now = states.at(torch.arange(states.number, device=device).repeat_interleave(span.values))
        values = {name: own.repeat_interleave(span.values) for name, own in some.items()}
        values[site] = support[: span.values].repeat(states.number)
        shape = (1, states.number, span.values)
        now, moments = course.go(now, values, begins[place], begins[place + 1], len(real))
        if span.last == steps and span.first == 0:
            now.throughout[site] = values[site]
        first, following = distinct_rows(now.key())
        index = torch.arange(span.values, device=device)
        index[-1] += max(len(own) for own in supports.values())  # that value or any later
        levels.append(
            Level(
                view=done + torch.arange(len(moments), device=device).view(shape),
                value=index.expand(shape),
                following=following.view(shape),
                rounds=torch.zeros(shape[:2], dtype=torch.long, device=device),
            )
        )
        rows.append(moments)
        done += len(moments)
        states = now.at(first)
    moments = torch.cat(rows)
    seen = moments[moments != NO_VIEW]
    used, which = seen.unique(return_inverse=True)
    moments[moments != NO_VIEW] = which
    if not len(used):  # of padding alone; act() is asked about something all the same
        used = used.new_zeros(1)
    first, view = distinct_rows(moments)
    chain = Chain(supports, tuple(levels), facts).of_views(view)
    belief, acted = course.moments(used)
    return ChainedViews(chain, moments[first], belief, acted)


@dataclass(frozen=True)
class _States:
    """n people with different histories; see the module.

    Attributes:
        combination: of implants ``[n]``.
        throughout: values ``[n]`` of sites that are read throughout the round.
        belief: ``[n]``, an index into all beliefs so far.
        knowledge: the domain's ``[n]``.
    """

    combination: Tensor
    throughout: dict[str, Tensor]
    belief: Tensor
    knowledge: Any

    @property
    def number(self) -> int:
        """Of states, n."""
        return len(self.combination)

    def at(self, rows: Tensor) -> _States:
        """Some of them."""
        return _States(
            self.combination[rows],
            {name: value[rows] for name, value in self.throughout.items()},
            self.belief[rows],
            map_state(lambda part: part[rows], self.knowledge),
        )

    def key(self) -> Tensor:
        """Whole numbers ``[n, ...]``, equal where states are."""
        known = [getattr(self.knowledge, part.name) for part in fields(self.knowledge)]
        columns = [self.combination, self.belief, *self.throughout.values()]
        columns = [as_whole_numbers(column)[:, None] for column in columns]
        return torch.cat(columns + [as_whole_numbers(part).flatten(1) for part in known], 1)


class _Course:
    """Beliefs along a round, each worked out once however often it comes about.

    Args:
        human: the model of people.
        combinations: values ``[M]`` of the discrete implants.
        observation: ``[1, T, ...]``.
        told: ``[1, T, K]``.
        actions: ``[T]``.
    """

    def __init__(
        self,
        human: HumanModel,
        combinations: Mapping[str, Tensor],
        observation: Observation,
        told: Visibility,
        actions: Tensor,
    ) -> None:
        self.human, self.combinations, self.actions = human, combinations, actions
        self.observation, self.told = observation, told
        like = next(human.parameters())
        self._beliefs = [like.new_zeros(1, human.belief_size)]
        self._known: dict[tuple[int, ...], int] = {}
        # Steps at which the same was done before the same observation are alike to the encoder.
        symbols = human.domain.symbols(observation)
        symbols = [as_whole_numbers(value[0]).flatten(1) for value in symbols.values()]
        rows = torch.cat(symbols, 1)
        self._observed = (rows @ random_keys(rows.shape[1], rows.device, 1)).tolist()
        self._done = [len(human.domain.actions), *actions.tolist()]

    def beginning(self, number: int) -> _States:
        """Of so many combinations before the first step, when every belief is zero."""
        device = self.actions.device
        every = torch.arange(number, device=device)
        knowledge = self.human.domain.nothing_known(number, device=device)
        return _States(every, {}, torch.zeros_like(every), knowledge)

    def go(
        self, states: _States, values: Mapping[str, Tensor], first: int, last: int, steps: int
    ) -> tuple[_States, Tensor]:
        """States after some steps, and the numbers of moments ``[n, T]`` on the way.

        Args:
            states: before them.
            values: of attention ``[n]``.
            first: of these steps.
            last: the step after them.
            steps: T.
        """
        number, belief, knowledge = states.number, states.belief, states.knowledge
        sites = {name: own[states.combination] for name, own in self.combinations.items()}
        moments = belief.new_full((number, steps), NO_VIEW)
        for step in range(first, last):
            now, told = (
                {name: value[:, step] for name, value in part.items()}
                for part in (self.observation, self.told)
            )
            view, knowledge = self.human.perceive({**sites, **values}, knowledge, now, told, step)
            view = view.map(lambda part: part.expand(number, *part.shape[1:]))
            knowledge = map_state(lambda part: part.expand(number, *part.shape[1:]), knowledge)
            belief = self._after(belief, view, step)
            moments[:, step] = belief * len(self.human.domain.actions) + self.actions[step]
        throughout = dict(states.throughout)
        return _States(states.combination, throughout, belief, knowledge), moments

    def _after(self, belief: Tensor, view: View, step: int) -> Tensor:
        """Beliefs ``[n]`` after looks at a step."""
        looks = torch.stack([belief, view.numbers()], -1)
        first, which = distinct_rows(looks)
        still = [False] * len(first) if view.still is None else view.still[first].tolist()
        keys, new = [], {}
        for place, (before, seen) in enumerate(looks[first].tolist()):
            # Where nothing came up, evidence does not count.
            shown = () if still[place] else (seen, self._observed[step])
            keys.append((before, self._done[step], *shown))
            if keys[-1] not in self._known:
                new.setdefault(keys[-1], place)
        if new:
            some = first[torch.tensor(list(new.values()), device=first.device)]
            found = self._inferred(belief[some], view.map(lambda part: part[some]), step)
            self._known.update(zip(new, found.tolist(), strict=True))
        places = [self._known[key] for key in keys]
        return torch.tensor(places, device=belief.device)[which]

    def _inferred(self, belief: Tensor, view: View, step: int) -> Tensor:
        """New beliefs ``[n]`` after others, or the same ones where nothing came up."""
        observation = {
            name: value[:, step].expand(len(belief), *value.shape[2:])
            for name, value in self.observation.items()
        }
        evidence = self.human.evidence(view, observation)
        every = torch.cat(self._beliefs)
        action = torch.full_like(belief, self._done[step])
        after = self.human.belief_after(every[belief], evidence, action, view.still)
        other = torch.ones_like(belief, dtype=torch.bool)
        if view.still is not None:
            other = ~view.still | (after != every[belief]).any(-1)
        self._beliefs = [every, after[other]]
        return torch.where(other, len(every) - 1 + other.cumsum(0), belief)

    def moments(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Beliefs ``[N, Z]`` and actions ``[N]`` of the moments with these numbers."""
        actions = len(self.human.domain.actions)
        return torch.cat(self._beliefs)[numbers // actions], numbers % actions

"""Tracks beliefs along a round, inferring each distinct belief once.

A belief is a function of the belief before, the action in between and the evidence perceived
(:mod:`mirror_ppl.models.human`). Where these three are equal, beliefs are equal. Simulation, tables
of views, chains and the planner all track beliefs by :meth:`BeliefState.after`.

n stands for people or histories that are tracked, m for distinct beliefs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains.base import (
    Observation,
    RepeatedObservation,
    Visibility,
    map_state,
    tensors_of,
)
from mirror_ppl.models.handlers import BELIEVING, WithoutSites
from mirror_ppl.models.human import HumanModel, overrides
from mirror_ppl.models.networks import Gaussian
from mirror_ppl.models.view import View
from mirror_ppl.row_appending import RowBuffer
from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows, row_numbers

CHUNK = 4096
"""Number of beliefs that are inferred at once; bounds memory."""
NOT_SHOWN = -1
"""Key of evidence that is not used because nothing is new."""


@dataclass(frozen=True)
class Transition:
    """The inputs of one step: implants, action, observation and messages.

    Attributes:
        implants: values ``[n, ...]`` of the sites that perception reads.
        action: the action in between ``[n]``; the number of actions at the start of a round.
        observation: full observations, ``[rows, ...]``.
        told: communicated items, ``[n, K]`` by modality, or ``[1, K]`` for all.
        row: row of the observation of each, ``[n]``; ``None`` if there is only one row.
    """

    implants: Mapping[str, Tensor]
    action: Tensor
    observation: Observation
    told: Visibility
    row: Tensor | None = None


@dataclass(frozen=True)
class Memory:
    """Cache of the beliefs inferred in R rounds so far, by their causes.

    Attributes:
        observed: a number for the observation of each step ``[R, T]``, equal where the encoder
            cannot tell observations apart.
        causes: belief before, action and key of the evidence, ``[k, 3]``.
        effects: the belief that follows from each, ``[k]``.
        beliefs: memory of the beliefs of all steps, to which those of a step are appended.
    """

    observed: Tensor
    causes: Tensor
    effects: Tensor
    beliefs: RowBuffer = field(default_factory=RowBuffer)

    @classmethod
    def of_rounds(cls, human: HumanModel, observation: Observation) -> Memory:
        """Return an empty cache for rounds with observations ``[R, T, ...]``."""
        symbols = human.domain.symbols(observation)
        if overrides(human, "evidence"):
            symbols = observation  # it may read whatever there is
        rows = torch.cat([as_whole_numbers(value).flatten(2) for value in symbols.values()], -1)
        observed = row_numbers(rows, 1)
        return cls(observed, observed.new_zeros(0, 3), observed.new_zeros(0))


@dataclass(frozen=True)
class BeliefState:
    """Beliefs and knowledge of n people before a step of their rounds.

    Attributes:
        human: the model of these people.
        mean: distinct beliefs ``[m, Z]``: of this step, or with a memory of all steps so far.
        scale: of their densities ``[m, Z]``; ``None`` before the first step, with a memory, or if
            beliefs have no density.
        belief: index of each person's belief, ``[n]``.
        knowledge: the domain's, ``[n]``.
        step: the number of the next step.
        memory: cache of inferred beliefs; no cache unless given.
        stayed: which of the beliefs of the step before each belief is ``[m]``, -1 if it is new;
            ``None`` if all may be new, or with a memory.
    """

    human: HumanModel
    mean: Tensor
    scale: Tensor | None
    belief: Tensor
    knowledge: Any
    step: int = 0
    memory: Memory | None = None
    stayed: Tensor | None = None

    @classmethod
    def initial(cls, human: HumanModel, number: int, memory: Memory | None = None) -> BeliefState:
        """Return the state of n people before the first step, when every belief is zero."""
        zero = next(human.parameters()).new_zeros(1, human.belief_size)
        own = torch.zeros(number, dtype=torch.long, device=zero.device)
        knowledge = human.nothing_known(number, device=zero.device)
        return cls(human, zero, None, own, knowledge, memory=memory)

    @property
    def believed(self) -> Tensor:
        """Belief of each person, ``[n, Z]``."""
        return self.mean[self.belief]

    def at(self, rows: Tensor | slice) -> BeliefState:
        """Select some of these people, possibly more than once."""
        knowledge = map_state(lambda part: part[rows], self.knowledge)
        return replace(self, belief=self.belief[rows], knowledge=knowledge)

    def key(self) -> Tensor:
        """Return whole numbers ``[n, ...]``, equal where belief and knowledge are equal."""
        known = [part[..., None].flatten(1) for part in tensors_of(self.knowledge)]
        floats = [part for part in known if part.is_floating_point()]
        known = [part.long() for part in known if not part.is_floating_point()]
        if floats:
            known.append(as_whole_numbers(torch.cat(floats, 1)))
        return torch.cat([self.belief[:, None], *known], 1)

    def distinct(self) -> tuple[BeliefState, Tensor]:
        """Return distinct beliefs with knowledge, and each person's index among them ``[n]``."""
        first, index = distinct_rows(self.key())
        return self.at(first), index

    def after(self, transition: Transition) -> BeliefState:
        """Return the state of the same people after one step."""
        return self.through([transition])[-1]

    def through(self, transitions: Sequence[Transition]) -> list[BeliefState]:
        """Return the state of the same people after each of several steps.

        Raises:
            HumanModelError: a method that computes beliefs has sample sites.
        """
        with WithoutSites(BELIEVING):
            return self._through(transitions)

    def _through(self, transitions: Sequence[Transition]) -> list[BeliefState]:
        number, steps = len(self.belief), len(transitions)
        views, knowledge = self.perceive(transitions)
        # Step by step, since all steps of many people do not fit into a cache.
        numbers = [one.numbers().expand(number) for one in views]
        row, observed = self._observed(transitions)
        key = torch.stack([torch.stack(numbers, -1), observed], -1)
        stills = [one.still.expand(number) for one in views if one.still is not None]
        still = torch.stack(stills, -1) if stills else None
        if still is not None:
            key = torch.where(still[..., None], NOT_SHOWN, key)
        key = row_numbers(key)  # [n, T]
        action = torch.stack([one.action for one in transitions], -1)
        # People with equal beliefs, actions and evidence are tracked as one.
        one, same = distinct_rows(torch.cat([self.belief[:, None], action, key], -1))
        first, shown = distinct_rows(key[one].view(-1, 1))
        step, order = (first % steps).sort(stable=True)
        person, shown = one[first[order] // steps], order.argsort()[shown]
        observation = [each.observation for each in transitions]
        counts = torch.bincount(step, minlength=steps).tolist()
        evidence = self.human.evidence(
            View.joined(
                [
                    view.map(lambda part, own=own: part.expand(number, *part.shape[1:])[own])
                    for view, own in zip(views, person.split(counts), strict=True)
                ]
            ),
            {
                name: (torch.cat([each[name] for each in observation]) if steps > 1 else value)[
                    row[person, step]
                ]
                for name, value in observation[0].items()
            },
        )
        shown = shown.view(-1, steps)
        # Views of equal evidence lead to equal beliefs, as of an item that is seen or imagined.
        causes = row_numbers(as_whole_numbers(evidence), 1)[shown]
        if still is not None:
            still = still[one]
            causes = torch.where(still, key[one], causes)
        parts = torch.stack([action[one], causes, shown])
        state, states = replace(self, belief=self.belief[one]), []
        for place in range(steps):
            stays = None if still is None else still[:, place]
            done, given, which = parts[..., place].unbind()
            state = state._infer(done, given, which, evidence, stays)
            states.append(replace(state, belief=state.belief[same], knowledge=knowledge[place]))
        return states

    def perceive(self, transitions: Sequence[Transition]) -> tuple[list[View], list[Any]]:
        """Return the views of several steps, ``[n, K]`` each, and the knowledge after each.

        They do not depend on beliefs.
        """
        number, knowledge = len(self.belief), self.knowledge
        views, known = [], []
        for step, one in enumerate(transitions, self.step):
            now = one.observation
            if one.row is not None:
                now = RepeatedObservation(now, one.row)
            view, knowledge = self.human.perceive(one.implants, knowledge, now, one.told, step)
            knowledge = map_state(lambda part: part.expand(number, *part.shape[1:]), knowledge)
            views.append(view)
            known.append(knowledge)
        return views, known

    def _observed(self, transitions: Sequence[Transition]) -> tuple[Tensor, Tensor]:
        """Return the row of each observation at each step ``[n, T]``, and keys of these."""
        rows, numbers, begin = [], [], 0
        for step, one in enumerate(transitions, self.step):
            own = torch.zeros_like(self.belief) if one.row is None else one.row
            rows.append(own + begin)
            begin += len(one.observation["ego"])
            if self.memory is not None:
                numbers.append(self.memory.observed[own, step])
        row = torch.stack(rows, -1)
        return row, torch.stack(numbers, -1) if numbers else row

    def _infer(
        self,
        action: Tensor,
        key: Tensor,
        shown: Tensor,
        evidence: Tensor,
        still: Tensor | None,
    ) -> BeliefState:
        """Return the state after a step, with knowledge unchanged.

        Args:
            action: the action in between ``[n]``.
            key: equal where evidence is equal, ``[n]``.
            shown: row of each person's evidence ``[n]``.
            evidence: ``[e, H]``.
            still: where nothing is new ``[n]``; nowhere unless given.
        """
        causes = torch.stack([self.belief, action, key], -1)
        mean, effects = self.mean[:0], causes[:0, 0]
        if self.memory is not None:
            mean, effects = self.mean, self.memory.effects
            causes = torch.cat([self.memory.causes, causes])
        known = len(effects)
        first, which = distinct_rows(causes)
        some = first[first >= known] - known
        before, begin = self.belief[some], len(mean)
        new = torch.ones_like(some, dtype=torch.bool)
        known_scale = self.scale is not None or self.memory is not None
        if still is not None and known_scale and not overrides(self.human, "believe"):
            new = ~still[some]
        found = []
        for own in some[new].split(CHUNK) if new.any() else ():
            stays = None if still is None else still[own]
            own_before = self.mean[self.belief[own]]
            found.append(self.human.infer(own_before, evidence[shown[own]], action[own], stays))
        scales = [part.scale for part in found if isinstance(part, Gaussian)]
        means = self.mean[before]
        if found:
            means[new] = torch.cat([part.mean if scales else part for part in found])
        scale = None if self.scale is None else self.scale[before]
        if scales and self.memory is None:
            before_scale, scale = scale, torch.empty_like(means)
            scale[new] = torch.cat(scales)
            if still is not None and before_scale is not None:
                # A belief that does not change keeps its scale.
                scale = torch.where(still[some, None], before_scale, scale)
        mean, stayed = means, None
        if self.memory is not None:
            mean = self.memory.beliefs.appended(self.mean, means)
        place = torch.arange(begin, len(mean), device=mean.device)
        if still is not None and len(some):
            stayed = torch.where(new, -1, before)
            # Beliefs that do not change are merged, however long ago they were formed.
            kept, own = _first_of_equal(mean if scale is None else torch.cat([mean, scale], 1))
            mean, scale, place = mean[kept], None if scale is None else scale[kept], own[begin:]
            stayed = stayed[kept] if self.memory is None else None
        effects = torch.cat([effects, torch.zeros_like(action)])
        effects[some + known] = place
        memory = self.memory
        if memory is not None:
            memory = replace(memory, causes=causes[first], effects=effects[first])
        return replace(
            self,
            mean=mean,
            scale=scale,
            belief=effects[first[which[known:]]],
            step=self.step + 1,
            memory=memory,
            stayed=stayed,
        )


def _first_of_equal(values: Tensor) -> tuple[Tensor, Tensor]:
    """Return a mask of the first of equal rows ``[n, Z]``, and each row's index among these."""
    first, which = distinct_rows(as_whole_numbers(values))
    origin = first[which]
    kept = origin == torch.arange(len(values), device=values.device)
    return kept, (kept.cumsum(0) - 1)[origin]

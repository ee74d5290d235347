"""Beliefs along a round, each of them inferred once.

At each step people perceive; what they perceive is evidence; from it, from their belief before and
from the action in between they infer a belief (:mod:`mirror_ppl.models.human`). Where these three
agree, beliefs agree. Simulation, tables of views, chains and the planner all track beliefs by
:meth:`BeliefState.after`.

n stands for people or histories that are tracked, m for distinct beliefs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, RepeatedObservation, Visibility, map_state
from mirror_ppl.models.handlers import BELIEVING, WithoutSites
from mirror_ppl.models.human import HumanModel, overrides
from mirror_ppl.models.networks import Gaussian
from mirror_ppl.models.view import View
from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows, row_numbers

CHUNK = 4096
"""Beliefs that are inferred at once; bounds memory."""
NOT_SHOWN = -1
"""Number of all evidence that does not count, because nothing came up."""


@dataclass(frozen=True)
class Transition:
    """What leads from one step to the next.

    Attributes:
        implants: values ``[n]`` of the discrete sites.
        action: what was done in between ``[n]``; the number of actions at the start of a round.
        observation: what there is to observe, ``[rows, ...]``.
        told: what is communicated, ``[n, K]`` by modality, or ``[1, K]`` for all.
        row: which of the observations each has, ``[n]``; ``None`` if all have the only one.
    """

    implants: Mapping[str, Tensor]
    action: Tensor
    observation: Observation
    told: Visibility
    row: Tensor | None = None


@dataclass(frozen=True)
class Memory:
    """How beliefs came about in R rounds so far, as the same can come about time and again.

    Attributes:
        observed: a number for the observation of each step ``[R, T]``, equal where the encoder
            cannot tell observations apart.
        causes: belief before, action and key of the evidence, ``[k, 3]``.
        effects: the belief after each of them, ``[k]``.
    """

    observed: Tensor
    causes: Tensor
    effects: Tensor

    @classmethod
    def of_rounds(cls, human: HumanModel, observation: Observation) -> Memory:
        """Of the beginning of rounds with observations ``[R, T, ...]``."""
        symbols = human.domain.symbols(observation)
        if overrides(human, "evidence"):
            symbols = observation  # it may read whatever there is
        rows = torch.cat([as_whole_numbers(value).flatten(2) for value in symbols.values()], -1)
        observed = row_numbers(rows, 1)
        return cls(observed, observed.new_zeros(0, 3), observed.new_zeros(0))


@dataclass(frozen=True)
class BeliefState:
    """What n people believe and know before a step of their rounds.

    Attributes:
        human: the model of these people.
        mean: distinct beliefs ``[m, Z]``: of this step, or with a memory of all steps so far.
        scale: of their densities ``[m, Z]``; ``None`` before the first step, with a memory, or if
            beliefs have no density.
        belief: which of them each has, ``[n]``.
        knowledge: the domain's, ``[n]``.
        step: the number of the next step.
        memory: of how beliefs came about; nothing is remembered unless it is given.
    """

    human: HumanModel
    mean: Tensor
    scale: Tensor | None
    belief: Tensor
    knowledge: Any
    step: int = 0
    memory: Memory | None = None

    @classmethod
    def initial(cls, human: HumanModel, number: int, memory: Memory | None = None) -> BeliefState:
        """Of n people before the first step, when every belief is zero."""
        zero = next(human.parameters()).new_zeros(1, human.belief_size)
        own = torch.zeros(number, dtype=torch.long, device=zero.device)
        knowledge = human.domain.nothing_known(number, device=zero.device)
        return cls(human, zero, None, own, knowledge, memory=memory)

    @property
    def believed(self) -> Tensor:
        """The belief of each person, ``[n, Z]``."""
        return self.mean[self.belief]

    def at(self, rows: Tensor | slice) -> BeliefState:
        """Of some of these people, or of some more than once."""
        knowledge = map_state(lambda part: part[rows], self.knowledge)
        return replace(self, belief=self.belief[rows], knowledge=knowledge)

    def key(self) -> Tensor:
        """Whole numbers ``[n, ...]``, equal where belief and knowledge are."""
        known = [getattr(self.knowledge, part.name) for part in fields(self.knowledge)]
        known = [as_whole_numbers(part).flatten(1) for part in known]
        return torch.cat([self.belief[:, None], *known], 1)

    def distinct(self) -> tuple[BeliefState, Tensor]:
        """Each belief with the same knowledge once, and which of these each person has ``[n]``."""
        first, index = distinct_rows(self.key())
        return self.at(first), index

    def after(self, transition: Transition) -> BeliefState:
        """What the same people believe and know after one step."""
        return self.through([transition])[-1]

    def through(self, transitions: Sequence[Transition]) -> list[BeliefState]:
        """What the same people believe and know after each of some steps.

        Raises:
            HumanModelError: a method that leads to beliefs has sites.
        """
        with WithoutSites(BELIEVING):
            return self._through(transitions)

    def _through(self, transitions: Sequence[Transition]) -> list[BeliefState]:
        number, steps = len(self.belief), len(transitions)
        view, knowledge = self.perceive(transitions)
        row, observed = self._observed(transitions)
        key = torch.stack([view.numbers().expand(number, steps), observed], -1)
        if view.still is not None:
            key = torch.where(view.still[..., None], NOT_SHOWN, key)
        key = row_numbers(key)  # [n, T]
        action = torch.stack([one.action for one in transitions], -1)
        # People with the same belief who then do the same and are shown the same count as one.
        one, same = distinct_rows(torch.cat([self.belief[:, None], action, key], -1))
        first, shown = distinct_rows(key[one].view(-1, 1))
        person, step = one[first // steps], first % steps
        observation = [each.observation for each in transitions]
        evidence = self.human.evidence(
            view.map(lambda part: part[person, step]),
            {
                name: (torch.cat([each[name] for each in observation]) if steps > 1 else value)[
                    row[person, step]
                ]
                for name, value in observation[0].items()
            },
        )
        still = None if view.still is None else view.still[one]
        parts = torch.stack([action[one], key[one], shown.view(-1, steps)])
        state, states = replace(self, belief=self.belief[one]), []
        for place in range(steps):
            stays = None if still is None else still[:, place]
            done, given, which = parts[..., place].unbind()
            state = state._infer(done, given, which, evidence, stays)
            states.append(replace(state, belief=state.belief[same], knowledge=knowledge[place]))
        return states

    def perceive(self, transitions: Sequence[Transition]) -> tuple[View, list[Any]]:
        """What these people perceive at each of some steps ``[n, T, K]``, and know after each.

        It does not depend on what they believe.
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
        return View.stack(views).map(lambda part: part.expand(number, *part.shape[1:])), known

    def _observed(self, transitions: Sequence[Transition]) -> tuple[Tensor, Tensor]:
        """Which of all observations each has at each step ``[n, T]``, and numbers of these."""
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
        """The state after a step, but for what they know.

        Args:
            action: what was done in between ``[n]``.
            key: equal where evidence is, ``[n]``.
            shown: which of the evidence each is shown ``[n]``.
            evidence: ``[e, H]``.
            still: for whom nothing came up ``[n]``; something always does unless given.
        """
        causes = torch.stack([self.belief, action, key], -1)
        mean, effects = self.mean[:0], causes[:0, 0]
        if self.memory is not None:
            mean, effects = self.mean, self.memory.effects
            causes = torch.cat([self.memory.causes, causes])
        known = len(effects)
        first, which = distinct_rows(causes)
        some = first[first >= known] - known
        found = []
        for own in some.split(CHUNK) if len(some) else ():
            stays = None if still is None else still[own]
            before = self.mean[self.belief[own]]
            found.append(self.human.infer(before, evidence[shown[own]], action[own], stays))
        scales = [part.scale for part in found if isinstance(part, Gaussian)]
        scale = torch.cat(scales) if scales and self.memory is None else None
        if still is not None and scale is not None and self.scale is not None:
            # A belief that stays as it is stays as sure as it was.
            scale = torch.where(still[some, None], self.scale[self.belief[some]], scale)
        begin = len(mean)
        mean = torch.cat([mean, *(part.mean if scales else part for part in found)])
        place = torch.arange(begin, len(mean), device=mean.device)
        if still is not None and len(some):
            # Beliefs that stay as they are, are the same ones however long ago they were formed.
            kept, own = _first_of_equal(mean if scale is None else torch.cat([mean, scale], 1))
            mean, scale, place = mean[kept], None if scale is None else scale[kept], own[begin:]
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
        )


def _first_of_equal(values: Tensor) -> tuple[Tensor, Tensor]:
    """Whether each row ``[n, Z]`` is the first of those equal to it, and which of these it is."""
    first, which = distinct_rows(as_whole_numbers(values))
    origin = first[which]
    kept = origin == torch.arange(len(values), device=values.device)
    return kept, (kept.cumsum(0) - 1)[origin]

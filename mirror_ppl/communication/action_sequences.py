"""Action sequences of people who receive candidate messages, with their probabilities.

:class:`mirror_ppl.communication.objectives.ExpectedUtility` sums rewards over them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.person import PlanningContext
from mirror_ppl.communication.rollouts import RolloutTree
from mirror_ppl.domains.base import Observation
from mirror_ppl.row_hashing import (
    as_whole_numbers,
    distinct_rows,
    mixed,
    row_numbers,
    uniform_of,
)


class ActionSequences:
    """Action sequences of each candidate and draw, sorted by draw; E sequences in all.

    Candidates that have led a draw to the same beliefs on the same paths, and go on with the same
    messages, have the same sequences from there on: they form a *group* and are computed once.

    Attributes:
        draw, path, weight, group: of each sequence ``[E]``.
        belief: index into ``state`` of the belief and knowledge after each ``[E]``.
        state: beliefs and knowledge after the last step.
        values: action values of these beliefs, ``[m, A]``.
        candidate: one candidate of each group, ``[G]``.
        group_of: group of each candidate and draw, ``[C, S]``.
    """

    def __init__(
        self, context: PlanningContext, candidates: Tensor, worlds: int, roots: int
    ) -> None:
        device = candidates.device
        person = self.person = context.person
        self.candidates, self.worlds = candidates, worlds
        self.actions = len(person.human.domain.actions)
        count = len(candidates)
        self.draw = torch.arange(person.number, device=device).repeat_interleave(count)
        self.candidate = torch.arange(count, device=device).repeat(person.number)
        self.group = torch.arange(len(self.draw), device=device)
        self.group_of = self.group.view(person.number, count).T
        self.path = self.draw % roots
        self.weight = torch.ones(len(self.draw), device=device)
        self.state = context.before
        self.belief = context.own[person.percept[self.draw]]
        self.values: Tensor | None = None
        self.last = torch.full_like(self.draw, context.last_action)

    def draw_of_world(self) -> Tensor:
        """Return the draw of the world of each sequence, ``[E]``."""
        return self.draw % self.worlds

    def of_each(self, values: Tensor) -> Tensor:
        """Sum values ``[E, ...]`` of sequences by candidate and draw, ``[C, S, ...]``."""
        total = values.new_zeros(len(self.candidate), *values.shape[1:])
        return total.index_add_(0, self.group, values)[self.group_of]

    def act(self, observation: Observation, step: int, channels: Channels) -> Tensor:
        """Perceive and act: return weights ``[E, A]`` of each sequence and its next action."""
        paths = len(observation["ego"]) // self.worlds
        row = self.draw_of_world() * paths + self.path
        percept = self.person.percept[self.draw]
        told = self.candidates[:, step] if step < self.candidates.shape[1] else None
        key = (self.belief * self.person.percept_count + percept) * (self.worlds * paths) + row
        message = None
        if told is not None:
            one, which = distinct_rows(told.long())
            message = which[self.candidate[self.group]]
            key = key * len(one) + message
            told = told[one]
        first, look = distinct_rows(key[:, None])
        if told is None or message is None:
            flags = torch.zeros(len(first), len(channels), dtype=torch.bool, device=key.device)
        else:
            # Items that are no longer communicable are dropped from the plan.
            communicable = channels.join(self.person.human.domain.communicable(observation))
            flags = told[message[first]] & communicable[row[first]]
        transition = self.person.transition(
            percept[first], self.last[first], observation, channels.split(flags), row[first]
        )
        before = self.state.at(self.belief[first])
        self.state, index = before.after(transition).distinct()
        self.belief = index[look]
        if told is not None:
            self._merge(self.candidates[:, step + 1 :])
        beliefs = self.state.mean
        values = self.values = self._values()
        # Sequences of a draw share its policy implants: one row a draw, padded to the longest.
        counts = torch.bincount(self.draw, minlength=self.person.number)
        begin = counts.cumsum(0) - counts
        place = torch.arange(len(self.draw), device=key.device) - begin[self.draw]
        padded = torch.zeros(len(counts), int(counts.max()), dtype=torch.long, device=key.device)
        padded[self.draw, place] = self.state.belief[self.belief]
        log_probabilities = self.person.act(beliefs[padded], values[padded])[self.draw, place]
        return self.weight[:, None] * log_probabilities.exp()

    def _values(self) -> Tensor:
        """Return action values of the beliefs ``[m, A]``; those that stayed have theirs."""
        beliefs, stayed = self.state.mean, self.state.stayed
        if stayed is None or self.values is None:
            return self.person.human.action_values(beliefs)
        values, new = self.values[stayed], stayed < 0
        if new.any():
            values[new] = self.person.human.action_values(beliefs[new])
        return values

    def _merge(self, rest: Tensor) -> None:
        """Merge groups that have the same sequences and the same ``rest`` ``[C, l, N]``."""
        parts = [self.path, self.belief, as_whole_numbers(self.weight), self.draw]
        own = mixed(row_numbers(torch.stack(parts, -1)))
        courses = own.new_zeros(len(self.candidate)).index_add_(0, self.group, own)
        _, following = distinct_rows(rest.flatten(1).long())
        first, which = distinct_rows(torch.stack([courses, following[self.candidate]], -1))
        kept = torch.zeros_like(self.candidate, dtype=torch.bool).index_fill_(0, first, True)
        course = kept[self.group].nonzero().squeeze(-1)
        self.candidate, self.group_of = self.candidate[first], which[self.group_of]
        self._keep(course)
        self.weight, self.path = self.weight[course], self.path[course]
        self.last = self.last[course]
        self.group = which[self.group]

    def _keep(self, course: Tensor) -> None:
        """Keep only these sequences, possibly some more than once."""
        self.draw, self.group = self.draw[course], self.group[course]
        self.belief = self.belief[course]

    def branch(
        self, probabilities: Tensor, rollouts: RolloutTree, step: int, threshold: float, seed: int
    ) -> None:
        """Extend the sequences by one action.

        Args:
            probabilities: weights of the extended sequences ``[E, A]``.
            rollouts: states that they lead to.
            step: number of actions of the present sequences.
            threshold: ``enumerate_above``, see
                :class:`mirror_ppl.communication.objectives.ExpectedUtility`.
            seed: of the sampling, which is the same for all candidates.
        """
        weight = probabilities
        if threshold > 0:
            small = probabilities < threshold
            # Systematic sampling: improbable siblings share one number, so that the number kept
            # differs from its expectation by less than one.
            total = torch.where(small, probabilities, 0.0).cumsum(-1) / threshold
            place = torch.full_like(self.draw, step)
            noise = uniform_of(seed, place, self.draw, rollouts.names(step)[self.path])
            shifted = total + noise[:, None]
            passed = shifted.floor()
            before = torch.cat([torch.zeros_like(passed[:, :1]), passed[:, :-1]], -1)
            weight = torch.where(small, threshold * (passed - before), probabilities)
        course, action = (weight > 0).nonzero(as_tuple=True)
        self.weight = weight[course, action]
        self.path = rollouts.follow(step, self.path[course], action)
        self.last = action
        self._keep(course)

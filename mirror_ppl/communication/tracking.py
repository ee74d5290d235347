"""Beliefs of a person along a round: at its next step they go on from where they were."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.models.belief_tracking import BeliefState, Transition
from mirror_ppl.row_hashing import distinct_rows

ROUNDS = 4
"""Rounds, or sets of percepts in a round, that are kept."""
PERCEPTS = 4096
"""Maximum number of percepts that are kept; bounds memory."""


@dataclass(frozen=True)
class Track:
    """Beliefs of percepts along a round.

    Attributes:
        sites: names of the sites that make a percept.
        percepts: their values ``[n, sites]``.
        past: the round so far.
        states: after each of its steps.
    """

    sites: Sequence[str]
    percepts: Tensor
    past: RoundSoFar
    states: Sequence[BeliefState]

    def of(self, sites: Sequence[str], percepts: Tensor, past: RoundSoFar) -> list[BeliefState]:
        """Return the states of percepts ``[u, sites]`` along a round, as far as they are known."""
        steps = len(self.states)
        if sites != self.sites or steps > past.time or not _begins(past, self.past, steps):
            return []
        _, numbers = distinct_rows(torch.cat([self.percepts, percepts]))
        known, wanted = numbers[: len(self.percepts)], numbers[len(self.percepts) :]
        place = torch.full_like(numbers, -1)
        place[known] = torch.arange(len(known), device=known.device)
        own = place[wanted]
        return [] if (own < 0).any() else [state.at(own) for state in self.states]


@dataclass(frozen=True)
class Tracks:
    """A cache of tracks; what it returns depends on it by rounding alone."""

    kept: deque[Track] = field(default_factory=lambda: deque(maxlen=ROUNDS))

    def through(
        self,
        percepts: Mapping[str, Tensor],
        past: RoundSoFar,
        initial: BeliefState,
        transitions: Callable[[int], Sequence[Transition]],
    ) -> list[BeliefState]:
        """Return the states of percepts after each step of a round so far.

        Args:
            percepts: values ``[n]`` by site.
            past: the round so far.
            initial: state before it, of each percept.
            transitions: returns the transitions from a step on.
        """
        sites = sorted(percepts)
        none = initial.belief.new_zeros(len(initial.belief))
        rows = torch.stack([percepts[name].long() for name in sites] or [none], -1)
        # The latest first, as it knows most of a round.
        known = (track.of(sites, rows, past) for track in reversed(self.kept))
        states = max(known, key=len, default=[])
        further = transitions(len(states))
        if further:
            states = [*states, *(states[-1] if states else initial).through(further)]
            if len(rows) <= PERCEPTS:
                self.kept.append(Track(sites, rows, past, states))
        return states


def _begins(past: RoundSoFar, other: RoundSoFar, steps: int) -> bool:
    """True if the first steps of two rounds are equal in all that beliefs after them depend on."""
    pairs = [(past.actions[: steps - 1], other.actions[: steps - 1])]
    for mine, its in ((past.observation, other.observation), (past.told, other.told)):
        pairs += [(part[:steps], its[name][:steps]) for name, part in mine.items()]
    return all(torch.equal(one, two) for one, two in pairs)

"""Tracks beliefs along a round that grows, one step at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.models.belief_tracking import BeliefState, Transition
from mirror_ppl.row_hashing import distinct_rows, joint_rows

TRACKS = 4
"""Number of tracks that are kept: of different rounds, or sets of percepts."""
PERCEPTS = 4096
"""Maximum number of percepts that are kept; bounds memory."""


@dataclass(frozen=True)
class Track:
    """Beliefs of percepts along a round.

    Attributes:
        sites: names of the sites that make a percept.
        percepts: their values as whole numbers ``[n, N]``.
        past: the round so far.
        states: after each of its steps.
    """

    sites: Sequence[str]
    percepts: Tensor
    past: RoundSoFar
    states: Sequence[BeliefState]

    def leads_to(self, past: RoundSoFar) -> bool:
        """True if beliefs after these steps are those after the first steps of another round."""
        steps = len(self.states)
        return _begin_alike(self.past, past, steps, steps - 1)

    def of(self, percepts: Tensor) -> list[BeliefState] | None:
        """Return the states of percepts ``[u, N]``; None if some of them were not tracked."""
        if torch.equal(percepts, self.percepts):
            return list(self.states)
        _, numbers = distinct_rows(torch.cat([self.percepts, percepts]))
        known, wanted = numbers[: len(self.percepts)], numbers[len(self.percepts) :]
        place = torch.full_like(numbers, -1)
        place[known] = torch.arange(len(known), device=known.device)
        own = place[wanted]
        return None if (own < 0).any() else [state.at(own) for state in self.states]


@dataclass(frozen=True)
class Tracks:
    """A cache of tracks.

    Cached and recomputed beliefs agree up to floating-point rounding. Copies in other processes
    begin empty.
    """

    kept: list[Track] = field(default_factory=list)

    def __reduce__(self) -> tuple[type[Tracks], tuple[()]]:
        """Leave out what is kept, which can be computed again."""
        return Tracks, ()

    def through(
        self,
        percepts: Mapping[str, Tensor],
        past: RoundSoFar,
        initial: BeliefState,
        transitions: Callable[[int], Sequence[Transition]],
    ) -> list[BeliefState]:
        """Return the states of percepts after each step of a round so far.

        Args:
            percepts: values ``[n, ...]`` by site.
            past: the round so far.
            initial: state before it, of each percept.
            transitions: returns the transitions from a step on.
        """
        sites = sorted(percepts)
        none = initial.belief.new_zeros(len(initial.belief), 1)
        rows = joint_rows({name: percepts[name] for name in sites}, none)
        track, states = self._longest(sites, rows, past)
        further = transitions(len(states))
        if further:
            states = [*states, *(states[-1] if states else initial).through(further)]
            if track is not None and len(track.percepts) == len(rows):
                self.kept[:] = [one for one in self.kept if one is not track]
            if len(rows) <= PERCEPTS:
                self.kept[:] = [*self.kept, Track(sites, rows, _copied(past), states)][-TRACKS:]
        return states

    def _longest(
        self, sites: Sequence[str], percepts: Tensor, past: RoundSoFar
    ) -> tuple[Track | None, list[BeliefState]]:
        """Return the track that knows most of a round, and the states of percepts there."""
        for track in sorted(self.kept, key=lambda one: -len(one.states)):
            if track.sites == sites and track.leads_to(past):
                states = track.of(percepts)
                if states is not None:
                    return track, states
        return None, []


@dataclass
class RunningSum:
    """A sum over the steps of a growing round, which goes on from where it was.

    Attributes:
        values: of sites, for which it is the sum.
        past: the round so far.
        total: of its steps; None before the first.
    """

    values: Mapping[str, Tensor] = field(default_factory=dict)
    past: RoundSoFar | None = None
    total: Tensor | None = None

    def __reduce__(self) -> tuple[type[RunningSum], tuple[()]]:
        """Leave out what can be computed again."""
        return RunningSum, ()

    def before(self, values: Mapping[str, Tensor], past: RoundSoFar) -> tuple[int, Tensor | None]:
        """Return how many steps of a round were added up, and their sum."""
        if self.past is None or self.values.keys() != values.keys():
            return 0, None
        steps = self.past.time
        if not all(torch.equal(self.values[name], value) for name, value in values.items()):
            return 0, None
        return (steps, self.total) if _begin_alike(self.past, past, steps, steps) else (0, None)

    def keep(self, values: Mapping[str, Tensor], past: RoundSoFar, total: Tensor) -> None:
        """Keep the sum of a round so far."""
        self.values, self.past, self.total = dict(values), _copied(past), total


def _begin_alike(one: RoundSoFar, other: RoundSoFar, steps: int, actions: int) -> bool:
    """True if two rounds have the same first steps, but for what was done after some actions."""
    if steps > other.time:
        return False
    pairs = [(one.actions[:actions], other.actions[:actions])]
    for mine, its in ((one.observation, other.observation), (one.told, other.told)):
        pairs += [(part[:steps], its[name][:steps]) for name, part in mine.items()]
    return all(torch.equal(mine, its) for mine, its in pairs)


def _copied(past: RoundSoFar) -> RoundSoFar:
    """Return a copy, so that buffers that a caller uses again do not change what is kept."""
    observation, told = (
        {name: value.clone() for name, value in part.items()}
        for part in (past.observation, past.told)
    )
    return RoundSoFar(observation, past.actions.clone(), told)

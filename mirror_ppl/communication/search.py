"""Searches for the best message: exhaustively, or by the cross-entropy method.

Search is independent of the human model: it proposes candidates and receives their values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from mirror_ppl.communication.messages import count_messages, every_message
from mirror_ppl.communication.objectives import Value, Valued
from mirror_ppl.cross_entropy import CrossEntropyOptions, best_sequences
from mirror_ppl.errors import InputError
from mirror_ppl.row_hashing import distinct_rows

MOST_CANDIDATES = 4096
"""Maximum number of candidates that are all valued; more are searched."""
FEW_MESSAGES = 4
"""Maximum number of messages of which all plans are valued at once."""
CHUNK = 512
"""Number of candidates that are valued at once; bounds memory."""


@dataclass(frozen=True)
class Found:
    """Candidates ``[C, L, N]``, silence first, with their values."""

    candidates: Tensor
    valued: Valued


class Search(Protocol):
    """A search method."""

    def __call__(self, value: Value, allowed: Tensor, seed: int) -> Found:
        """Return candidates made of the allowed items ``[N]``, silence first."""
        ...


@dataclass(frozen=True)
class Exhaustive:
    """Values every message for now, with silence afterwards.

    Attributes:
        items: most items of a message; any number unless given.
    """

    items: int | None = None

    def __call__(self, value: Value, allowed: Tensor, seed: int) -> Found:
        """Return candidates with their values; the seed is not used, see :class:`Search`."""
        candidates = every_message(allowed, self.items)[:, None]
        return Found(candidates, in_chunks(value, candidates))


@dataclass(frozen=True)
class Patient:
    """Values every message for now, and delayed and split versions of the best.

    Compared with permanent silence alone, a message is sent as soon as it helps. It may help as
    much a step later, or turn out not to be needed, and items sent one by one cost less than
    together. So the best messages are also valued as plans: the same message 1 to ``steps - 1``
    steps later, and each of its items now with the rest in the next step. If there are few
    messages, the plans of all of them are valued at once, which is faster.

    Attributes:
        steps: length L of the plans.
        best: number of messages of which plans are valued.
        items: most items of a message; any number unless given.
    """

    steps: int = 3
    best: int = 6
    items: int | None = None

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise InputError(f"steps must be at least 1, not {self.steps}")

    def __call__(self, value: Value, allowed: Tensor, seed: int) -> Found:
        """Return candidates with their values; the seed is not used, see :class:`Search`."""
        if self.steps > 1 and count_messages(allowed, self.items) <= FEW_MESSAGES:
            messages = every_message(allowed, self.items)
            plans = [_at_once(messages, self.steps), *self._plans(messages[1:])]
            candidates = torch.cat(plans)
            return Found(candidates, in_chunks(value, candidates))
        first = Exhaustive(self.items)(value, allowed, seed)
        mean = first.valued.mean
        better = (mean > mean[0]).nonzero().squeeze(-1)
        if self.steps == 1 or not len(better):
            return first
        better = better[mean[better].argsort(descending=True, stable=True)][: self.best]
        now = _at_once(first.candidates[:, 0], self.steps)
        plans = torch.cat(self._plans(first.candidates[better, 0]))
        return joined(Found(now, first.valued), plans, value)[0]

    def _plans(self, messages: Tensor) -> list[Tensor]:
        """Return delayed and split versions ``[C, L, N]`` of messages ``[M, N]``, in parts."""
        plans = []
        for message in messages:
            later = message.new_zeros(self.steps - 1, self.steps, len(message))
            for delay in range(1, self.steps):
                later[delay - 1, delay] = message
            plans.append(later)
            items = message.nonzero().squeeze(-1)
            if len(items) > 1:
                split = message.new_zeros(len(items), self.steps, len(message))
                every = torch.arange(len(items), device=message.device)
                split[:, 1] = message
                split[every, 0, items], split[every, 1, items] = True, False
                plans.append(split)
        return plans


def _at_once(messages: Tensor, steps: int) -> Tensor:
    """Return plans ``[M, L, N]`` that send messages ``[M, N]`` now, followed by silence."""
    return torch.nn.functional.pad(messages[:, None], [0, 0, 0, steps - 1])


@dataclass(frozen=True)
class CrossEntropy:
    """Searches sequences of messages by the cross-entropy method.

    Candidates are the best sequence found and its variations: each of its items left out, and its
    first message followed by silence.

    Attributes:
        steps: length L of the sequences.
        options: of the method. Messages have few items, so the start probability is low.
    """

    steps: int = 1
    options: CrossEntropyOptions = CrossEntropyOptions(
        samples=256, elites=32, iterations=6, smoothing=0.5, start_probability=0.15
    )

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise InputError(f"steps must be at least 1, not {self.steps}")

    def __call__(self, value: Value, allowed: Tensor, seed: int) -> Found:
        """Return candidates with their values, see :class:`Search`."""
        places = allowed.nonzero().squeeze(-1)
        number = len(places)

        def sequences(bits: Tensor) -> Tensor:
            candidates = allowed.new_zeros(len(bits), self.steps, len(allowed))
            candidates[..., places] = bits.view(len(bits), self.steps, number)
            return candidates

        def mean(bits: Tensor) -> Tensor:
            distinct, which = torch.unique(bits, dim=0, return_inverse=True)
            return in_chunks(value, sequences(distinct)).mean[which]

        generator = torch.Generator(allowed.device).manual_seed(seed)
        best, _ = best_sequences(mean, (), self.steps * number, generator, self.options)
        items = best.nonzero().squeeze(-1)
        without = best.repeat(len(items), 1)
        without[torch.arange(len(items)), items] = False
        alone = best.clone()
        alone[number:] = False
        bits = torch.cat([torch.zeros_like(best)[None], best[None], alone[None], without])
        candidates = sequences(bits)
        return Found(candidates, in_chunks(value, candidates))


@dataclass(frozen=True)
class Automatic:
    """Uses :class:`Patient` for few candidates, else :class:`CrossEntropy`.

    Attributes:
        steps: length L of the plans.
        most: maximum number of messages for :class:`Patient`.
        items: most items of a message of :class:`Patient`; any number unless given.
    """

    steps: int = 3
    most: int = MOST_CANDIDATES
    items: int | None = None

    def __call__(self, value: Value, allowed: Tensor, seed: int) -> Found:
        """Return candidates with their values, see :class:`Search`."""
        if count_messages(allowed, self.items) <= self.most:
            return Patient(self.steps, items=self.items)(value, allowed, seed)
        return CrossEntropy(self.steps)(value, allowed, seed)


def joined(found: Found, more: Tensor, value: Value) -> tuple[Found, Tensor]:
    """Append candidates ``[C, L, N]``; returns all candidates and the indices of these.

    Candidates that were already valued are not valued again.
    """
    known = len(found.candidates)
    first, which = distinct_rows(torch.cat([found.candidates, more]).flatten(1).long())
    # The first of equal rows: below ``known`` where a candidate is not new.
    place = first[which[known:]]
    new, order = place[place >= known].unique(return_inverse=True)
    if not len(new):
        return found, place
    place[place >= known] = known + order
    added = more[new - known]
    valued = in_chunks(value, added)
    actions = None
    if found.valued.actions is not None and valued.actions is not None:
        actions = torch.cat([found.valued.actions, valued.actions])
    utility = torch.cat([found.valued.utility, valued.utility])
    both = Valued(utility, actions, valued.worlds)
    return Found(torch.cat([found.candidates, added]), both), place


def in_chunks(value: Value, candidates: Tensor) -> Valued:
    """Value many candidates ``[C, L, N]``, a chunk at a time."""
    parts = [value(part) for part in candidates.split(CHUNK)]
    actions = [part.actions for part in parts if part.actions is not None]
    utility = torch.cat([part.utility for part in parts])
    return Valued(utility, torch.cat(actions) if actions else None, parts[0].worlds)

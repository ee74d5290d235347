"""Finding the message that is worth most: every candidate, or the cross-entropy method.

Search knows nothing of people: it proposes candidates and is told what they are worth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from mirror_ppl.communication.messages import count_messages, every_message
from mirror_ppl.communication.objectives import Value, Valued
from mirror_ppl.cross_entropy import CrossEntropyOptions, best_sequences
from mirror_ppl.row_hashing import distinct_rows

MOST_CANDIDATES = 4096
"""How many candidates are valued one by one; beyond that they are searched."""
FEW_MESSAGES = 4
"""Up to how many messages all plans are valued at once."""
CHUNK = 512
"""Candidates that are valued at once; bounds memory."""


@dataclass(frozen=True)
class Found:
    """Candidates ``[C, L, N]`` with their values; silence comes first."""

    candidates: Tensor
    valued: Valued


class Search(Protocol):
    """A way to search."""

    def __call__(self, value: Value, allowed: Tensor, seed: int) -> Found:
        """Candidates made of the allowed items ``[N]``, silence first."""
        ...


@dataclass(frozen=True)
class Exhaustive:
    """Every message for now, and silence afterwards.

    Attributes:
        items: most items of a message; any number unless given.
    """

    items: int | None = None

    def __call__(self, value: Value, allowed: Tensor, seed: int) -> Found:
        """See :class:`Search`; the seed is not used."""
        candidates = every_message(allowed, self.items)[:, None]
        return Found(candidates, in_chunks(value, candidates))


@dataclass(frozen=True)
class Patient:
    """Every message for now; and, of the best or of a few, whether they can wait or be split.

    A message that is compared with silence for good is said as soon as it helps. Much of what would
    help now helps as well a step later, or turns out not to be needed, and items told one by one
    cost less than together. So the best messages are also valued as plans: the same message 1 to
    ``steps - 1`` steps later, and each of its items now with the rest in the next step. If there
    are few messages, plans of all of them are valued at once, which is quicker.

    Attributes:
        steps: length L of the plans.
        best: how many messages are looked at in this way.
        items: most items of a message; any number unless given.
    """

    steps: int = 3
    best: int = 6
    items: int | None = None

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1, not {self.steps}")

    def __call__(self, value: Value, allowed: Tensor, seed: int) -> Found:
        """See :class:`Search`; the seed is not used."""
        if self.steps > 1 and count_messages(allowed, self.items) <= FEW_MESSAGES:
            messages = every_message(allowed, self.items)
            plans = [_at_once(messages, self.steps), *self._plans(messages[1:])]
            candidates = torch.cat(plans)
            return Found(candidates, in_chunks(value, candidates))
        first = Exhaustive(self.items)(value, allowed, seed)
        mean = first.valued.utility.mean(-1)
        better = (mean > mean[0]).nonzero().squeeze(-1)
        if self.steps == 1 or not len(better):
            return first
        better = better[mean[better].argsort(descending=True, stable=True)][: self.best]
        now = _at_once(first.candidates[:, 0], self.steps)
        plans = torch.cat(self._plans(first.candidates[better, 0]))
        return joined(Found(now, first.valued), plans, value)[0]

    def _plans(self, messages: Tensor) -> list[Tensor]:
        """What else can become of messages ``[M, N]``: plans ``[C, L, N]``, in parts."""
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
    """Plans ``[M, L, N]`` of messages ``[M, N]`` for now."""
    return torch.nn.functional.pad(messages[:, None], [0, 0, 0, steps - 1])


@dataclass(frozen=True)
class CrossEntropy:
    """The cross-entropy method over sequences of messages.

    The best sequence found comes with its variations: each of its items left out, and its first
    message followed by silence.

    Attributes:
        steps: length L of the sequences.
        options: how hard to search. A message has few items, so few are tried at the start.
    """

    steps: int = 1
    options: CrossEntropyOptions = CrossEntropyOptions(
        samples=256, elites=32, iterations=6, smoothing=0.5, start_probability=0.15
    )

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1, not {self.steps}")

    def __call__(self, value: Value, allowed: Tensor, seed: int) -> Found:
        """See :class:`Search`."""
        places = allowed.nonzero().squeeze(-1)
        number = len(places)

        def sequences(bits: Tensor) -> Tensor:
            candidates = allowed.new_zeros(len(bits), self.steps, len(allowed))
            candidates[..., places] = bits.view(len(bits), self.steps, number)
            return candidates

        def mean(bits: Tensor) -> Tensor:
            distinct, which = torch.unique(bits, dim=0, return_inverse=True)
            return in_chunks(value, sequences(distinct)).utility.mean(-1)[which]

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
    """:class:`Patient` where candidates are few, else :class:`CrossEntropy`.

    Attributes:
        steps: length L of the plans.
        most: the largest number of messages that are valued one by one.
        items: most items of a message where they are; any number unless given.
    """

    steps: int = 3
    most: int = MOST_CANDIDATES
    items: int | None = None

    def __call__(self, value: Value, allowed: Tensor, seed: int) -> Found:
        """See :class:`Search`."""
        if count_messages(allowed, self.items) <= self.most:
            return Patient(self.steps, items=self.items)(value, allowed, seed)
        return CrossEntropy(self.steps)(value, allowed, seed)


def joined(found: Found, more: Tensor, value: Value) -> tuple[Found, Tensor]:
    """What was found with more candidates ``[C, L, N]`` after it, and where each of these is.

    Those that are there already are not valued again.
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
    return Found(torch.cat([found.candidates, added]), Valued(utility, actions)), place


def in_chunks(value: Value, candidates: Tensor) -> Valued:
    """Values of many candidates ``[C, L, N]``."""
    parts = [value(part) for part in candidates.split(CHUNK)]
    actions = [part.actions for part in parts if part.actions is not None]
    return Valued(
        torch.cat([part.utility for part in parts]), torch.cat(actions) if actions else None
    )

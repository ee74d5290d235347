"""The round that messages changed most, played back with and without them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from mirror_ppl.communication.messages import Channels
from mirror_ppl.domains.base import Domain, Observation, Visibility, map_state
from mirror_ppl.errors import OptionError
from mirror_ppl.evaluation.assistance_cells import Pairing
from mirror_ppl.evaluation.played import Played
from mirror_ppl.plots.communication import WORDS
from mirror_ppl.plots.film import Film, Strip

SILENT = "none"


def compared(communicators: Sequence[str]) -> tuple[str, str]:
    """Choose two communicators for a film: none, if it is there, and the first other.

    Raises:
        OptionError: there is only one.
    """
    others = [name for name in dict.fromkeys(communicators) if name != SILENT]
    chosen = ([SILENT] if SILENT in communicators else []) + others
    if len(chosen) == 1:
        raise OptionError(f"--film compares two communicators, not {chosen[0]} alone")
    return chosen[0], chosen[1]


def film(
    pairing: Pairing,
    played: Mapping[str, Sequence[Played]],
    communicators: Sequence[str] | None = None,
) -> Film:
    """Play back the round in which the second communicator gained most over the first.

    Args:
        pairing: that was played, with ``keep_log``.
        played: results of the P people by communicator, at least two.
        communicators: their names in the order that :func:`compared` reads; as in ``played``
            unless given.
    """
    pair = compared([name for name in communicators or played if name in played])
    first, second = ([one.net for one in played[name]] for name in pair)
    gain = np.stack(second) - np.stack(first)
    person, number = (int(index) for index in np.unravel_index(gain.argmax(), gain.shape))
    (listener,) = pairing.listeners([pairing.people[person]], inferred=False)
    begin = listener.start.round(number).state
    sees = listener.driver.sees
    a, b = (strip(pairing.domain, begin, name, played[name][person], number, sees) for name in pair)
    return Film(pairing.domain, person, number, (a, b))


def strip(
    domain: Domain,
    state: Any,
    name: str,
    played: Played,
    number: int,
    sees: Callable[[Observation], Visibility],
) -> Strip:
    """Play back one round by its logged actions.

    Args:
        domain: the world, whose transitions are deterministic.
        state: initial state of the round, ``[1, 1]``.
        name: of the communicator.
        played: a person's rounds, with their log.
        number: of the round.
        sees: what the person sees of an observation without messages.
    """
    log = [entry for entry in played.log if entry["round"] == number]
    states, mishaps = [state], []
    for step, entry in enumerate(log):
        action = torch.tensor([[domain.actions.index(entry["action"])]])
        states.append(domain.transition(states[-1], action))
        rewards = domain.rewards(states[-2], action, states[-1])
        if bool(rewards[domain.mishap[0]] < 0):
            mishaps.append(step)
    channels = Channels(domain)
    messages = [*(entry["message"] for entry in log), {}]
    told = [channels.split(channels.flags(message)) for message in messages]
    seen = [
        {name: mask[0, 0] | said[name] for name, mask in sees(domain.observe(one)).items()}
        for one, said in zip(states, told, strict=True)
    ]
    return Strip(
        name,
        [map_state(lambda part: part[0, 0], one) for one in states],
        seen,
        [_words(entry["message"]) for entry in log],
        [entry["action"] for entry in log],
        [_gain(entry) for entry in log],
        float(played.net[number]),
        mishaps,
    )


def _gain(entry: Mapping[str, Any]) -> float:
    """Expected gain of what is communicated now; plans that wait gain later."""
    return float(entry.get("gain", 0.0)) if any(entry["message"].values()) else 0.0


def _words(message: Mapping[str, Sequence[str]]) -> list[str]:
    """Describe items by modality, as in "shown: front-left"."""
    return [
        f"{WORDS.get(modality, modality)}: {item}"
        for modality, items in message.items()
        for item in items
    ]

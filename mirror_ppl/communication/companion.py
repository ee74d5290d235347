"""A communicator to call from the loop of a simulator or robot."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mirror_ppl.checks import require_kind
from mirror_ppl.communication.communicator import Communicator
from mirror_ppl.communication.decision import Decision
from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains.base import require_known
from mirror_ppl.domains.controls import action_at
from mirror_ppl.errors import InputError, shown


class Companion:
    """Receives what happens in rounds of one person, and plans the messages to them::

        companion = Companion(communicator)
        companion.begin(observation)
        while ...:
            decision = companion.decide()       # send decision.message
            companion.observe(observation, action)
        companion.begin(observation)            # the next round; learned channels are kept

    Observations are dicts of numpy arrays, tensors or lists: ``ego`` ``[E]``, each modality
    ``[K, F]``, the full observation of the robot.

    Args:
        communicator: for the first round.

    Attributes:
        communicator: for the present round.
        past: the present round so far; ``None`` before the first.
    """

    def __init__(self, communicator: Communicator) -> None:
        self.communicator = require_kind(communicator, Communicator, "communicator")
        self.past: RoundSoFar | None = None
        self._decision: Decision | None = None

    def begin(self, observation: Mapping[str, Any]) -> None:
        """Begin a round; the round before updates which channels reach the person.

        Raises:
            InputError: the observation is impossible; nothing has changed then.
        """
        past = RoundSoFar.begin(self.communicator.person.human.domain, observation)
        if self.past is not None and self.past.time:
            self.communicator = self.communicator.after(self.past)
        self.past, self._decision = past, None

    def decide(self) -> Decision:
        """Return the decision for now, which is fixed until the next `observe`.

        Raises:
            InputError: no round has begun.
        """
        if self._decision is None:
            self._decision = self.communicator.plan(self._round())
        return self._decision

    def observe(
        self,
        observation: Mapping[str, Any],
        action: str | int | Sequence[float],
        message: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        """Record the person's action and the observation after it.

        Args:
            observation: the observation after the action.
            action: name or index of the action; in a world with controls their values ``[C]``.
            message: names of the items that were communicated before it, by modality; unless given,
                those of the decision, or none if there was no decision.

        Raises:
            InputError: no round has begun or it is over, or an argument is impossible; nothing has
                changed then.
            UnknownNameError: there is no such modality, item or action.
        """
        past, domain = self._round(), self.communicator.person.human.domain
        if past.time >= domain.horizon:
            raise InputError(f"the round is over after its {domain.horizon} steps; call begin")
        channels = Channels(domain)
        if message is None and self._decision is not None:
            told = self._decision.told
        else:
            told = channels.split(channels.flags(_named(message or {})))
        if domain.controls:
            number = action_at(domain.controls, action)
        elif isinstance(action, str):
            number = domain.actions.index(require_known(action, "action", domain.actions))
        else:
            number = action
        after = past.then(told, number, observation)  # pyright: ignore[reportArgumentType]
        after.check(domain)
        self.past, self._decision = after, None

    def _round(self) -> RoundSoFar:
        if self.past is None:
            raise InputError("no round has begun; call begin with the first observation")
        return self.past


def _named(message: Any) -> dict[str, tuple[str, ...]]:
    """Return the names of a message's items by modality."""
    expected = 'a message has lists of names by modality, as {"visual": ["front-left"]}'
    if not isinstance(message, Mapping):
        raise InputError(f"{expected}, not {shown(message)}")
    for name, items in message.items():
        if isinstance(items, str) or not isinstance(items, Iterable):
            raise InputError(f"{expected}; {name!r} has {items!r}, which is no list")
    return {name: tuple(items) for name, items in message.items()}

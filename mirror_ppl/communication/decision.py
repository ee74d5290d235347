"""A decision: the message for one step, its gain over silence, and why it was chosen."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mirror_ppl.communication.messages import Channels, Message
from mirror_ppl.communication.objectives import Valued
from mirror_ppl.communication.search import Found
from mirror_ppl.domains.base import Domain, Observation, Visibility
from mirror_ppl.domains.world import offers

if TYPE_CHECKING:
    import pandas as pd

UPPER = 0.95
"""Upper end of a 90% interval."""
LITTLE = 0.01
"""Changes of a probability below this are not reported as explanations."""
ADVICE_DISCOUNT = 0.95
"""Discount per step in advice."""
SHOWN = 0.005
"""Gains below this are printed as 0.00."""
TIE = 1e-6
"""Gains up to this, in units of reward, count as none."""


@dataclass(frozen=True)
class Gain:
    """Gain of a message over silence, in units of reward, net of its cost.

    Attributes:
        mean: over posterior draws.
        standard_error: of that mean.
        probability: share of the draws in which the message is better.
        number: of independent draws, of the posterior or, in a random world, of the world.
    """

    mean: float
    standard_error: float
    probability: float
    number: int = 1

    @property
    def interval(self) -> tuple[float, float]:
        """90% interval of the mean, by Student's t; the mean alone if there is a single draw."""
        if self.number == 1:
            return self.mean, self.mean
        from scipy.special import stdtrit

        width = float(stdtrit(self.number - 1, UPPER)) * self.standard_error
        return self.mean - width, self.mean + width

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.mean:+.2f} [{low:+.2f}, {high:+.2f}]"


@dataclass(frozen=True, repr=False)
class Decision:
    """A message, and why it was chosen.

    Attributes:
        message: the message for now.
        flags: the message as flags ``[N]``.
        gain: gain of the plan over permanent silence; also where the plan begins with silence.
        domain: the world of the round.
        observation: the full observation, ``[E]`` and ``[K, F]``.
        found: the candidates that were compared; ``None`` if there was no choice.
        chosen: index of the plan among them.
        world: the world as the robot knows it, for advice.
        over: whether the round is over.
        standard_errors: that a gain had to exceed.
        because: a reason for silence besides gains, if there is one.
    """

    message: Message
    flags: Tensor
    gain: Gain
    domain: Domain
    observation: Observation
    found: Found | None
    chosen: int
    world: Domain
    over: bool = False
    standard_errors: float = 0.0
    because: str = ""

    def __repr__(self) -> str:
        return f"Decision({self.why()})"

    @property
    def told(self) -> Visibility:
        """Message as masks ``[K]`` by modality."""
        return Channels(self.domain).split(self.flags)

    @property
    def plan(self) -> tuple[Message, ...]:
        """Message for now, and the planned messages of the steps after it."""
        channels = Channels(self.domain)
        if self.found is None:
            return (self.message,)
        return tuple(channels.message(flags) for flags in self.found.candidates[self.chosen])

    @property
    def cost(self) -> float:
        """Cost of the message in units of reward."""
        return float(Channels(self.domain).cost(self.flags))

    @cached_property
    def alternatives(self) -> pd.DataFrame:
        """All candidates with their gain over silence, the best first.

        Columns: ``message`` (for now), ``later`` (messages of the steps after), ``cost`` (of both),
        ``gain`` (net of cost), its ``standard_error``, ``low``, ``high`` (90% interval),
        ``probability`` (share of draws in which it is better than silence), ``chosen``, and
        ``p(action)``, the predicted probability of each action now.
        """
        import pandas as pd

        channels = Channels(self.domain)
        if self.found is None:
            candidates, valued = self.flags[None, None], None
        else:
            candidates, valued = self.found.candidates, self.found.valued
        rows: list[dict[str, Any]] = []
        for index, candidate in enumerate(candidates):
            gain = Gain(0.0, 0.0, 0.0) if valued is None else gain_over_silence(valued, index)
            row: dict[str, Any] = {
                "message": str(channels.message(candidate[0])),
                "later": "; ".join(
                    f"{_in(step)}: {channels.message(flags)}"
                    for step, flags in enumerate(candidate)
                    if step > 0 and flags.any()
                ),
                "cost": float(channels.cost(candidate).sum()),
                "gain": gain.mean,
                "standard_error": gain.standard_error,
                "low": gain.interval[0],
                "high": gain.interval[1],
                "probability": gain.probability,
                "chosen": index == self.chosen,
            }
            if valued is not None and valued.actions is not None:
                probabilities = valued.actions[index, 0].tolist()
                row |= {
                    f"p({action})": chance
                    for action, chance in zip(self.domain.actions, probabilities, strict=True)
                }
            rows.append(row)
        return pd.DataFrame(rows).sort_values("gain", ascending=False, kind="stable")

    @cached_property
    def matters(self) -> dict[tuple[str, str], float]:
        """Contribution of each communicated item: the gain lost if only this item is left out now.

        Items without which the plan was not among the candidates are missing.
        """
        if self.found is None:
            return {}
        candidates, mean = self.found.candidates, self.found.valued.mean
        plan = candidates[self.chosen]
        result = {}
        for place, pair in enumerate(Channels(self.domain).pairs):
            if plan[0, place]:
                less = plan.clone()
                less[0, place] = False
                without = (candidates == less).flatten(1).all(1).nonzero()
                if len(without):
                    result[pair] = float(mean[self.chosen] - mean[without[0, 0]])
        return result

    @property
    def turning_point(self) -> tuple[int, int, float, float] | None:
        """First large effect of the message: step, action, probability without and with it."""
        if self.found is None or self.chosen == 0 or self.found.valued.actions is None:
            return None
        silent, told = self.found.valued.actions[0], self.found.valued.actions[self.chosen]
        silent, told = (each / each.sum(-1, keepdim=True) for each in (silent, told))
        # Among actions that the message makes less probable, the first with a large change.
        less = silent - told
        place = int((less >= less.max() / 2).flatten().long().argmax())
        step, action = divmod(place, silent.shape[-1])
        return step, action, float(silent[step, action]), float(told[step, action])

    def why(self) -> str:
        """Explain the decision in one sentence of plain English."""
        if not self.message:
            return f"silence: {self._why_not()}"
        ranked = sorted(self.message, key=lambda pair: -self.matters.get(pair, 0.0))
        text = self._about(ranked)
        turn = self.turning_point
        if turn is None:
            return f"{text}: brings their belief closer to the truth"
        step, action, without, told = turn
        worth = f"(gain {self.gain.mean:+.2f}{self._with_later()})"
        if without - told < LITTLE:
            return f"{text}: slightly changes what they do in the steps ahead {worth}"
        # Their lane at later steps is not known.
        deed = self.domain.deed(self.observation, None if step else ranked[0][1], action)
        when = "" if step == 0 else f" {_in(step)}"
        likely = f"with probability {without:.2f}; with the message, {told:.2f}"
        return f"{text}: they would {deed}{when} {likely} {worth}"

    @property
    def advice(self) -> str:
        """Action that the robot recommends now, and the items it depends on.

        It uses the full observation and what the robot learned about the world, such as the rules.
        The supplement's robot advises a button in bomb defusal.
        """
        if self.over:
            return "the round is over"
        world, now = self.world, self.observation
        if not offers(world, "reference_values") or world.partly_observed or world.random:
            return f"none: the best action is not known exactly in {world.name}"
        values = world.reference_values(world.state_behind(now), ADVICE_DISCOUNT)
        notion = next(iter(world.relevance(now).values()))
        flags = Channels(world).join(notion)
        about = self._about(
            pair for pair, flag in zip(Channels(world).pairs, flags.tolist(), strict=True) if flag
        )
        deed = world.deed(now, None, int(values.argmax()))
        return f"{deed}: {about}" if about else deed

    def _with_later(self) -> str:
        """Name the later messages of the plan, since the gain is of all of it."""
        later = [
            f"{_in(step)}: {self._about(message)}"
            for step, message in enumerate(self.plan)
            if step and message
        ]
        return f" with what follows {'; '.join(later)}" if later else ""

    def _why_not(self) -> str:
        if self.over:
            return "the round is over"
        if self.because:
            return self.because
        if self.found is None:
            return "there is nothing new to communicate now"
        for step, message in enumerate(self.plan):
            if message:
                return f"{self._about(message)}: can wait {step} step{'s' * (step > 1)}"
        valued = self.found.valued
        gain = gain_over_silence(valued, int(valued.mean.argmax()))
        if gain.mean >= SHOWN:
            gains = valued.utility - valued.utility[:1]
            least = least_gains(valued, gains, self.standard_errors)
            if bool((least > TIE).any()):
                return f"no item of a message is reliably worth its cost (the best gains {gain})"
            why = ""
            if gain.interval[0] > 0:
                why = f", fewer than {self.standard_errors:g} standard errors"
            return f"no message is reliably worth its cost (the best gains {gain}{why})"
        return "no message is worth its cost"

    def _about(self, items: Iterable[tuple[str, str]]) -> str:
        about = [self.domain.describe(self.observation, *pair) for pair in items]
        return ", and ".join(dict.fromkeys(about))


def _in(step: int) -> str:
    return f"in {step} step{'s' * (step > 1)}"


def standard_error(valued: Valued, gain: Tensor) -> Tensor:
    """Return the standard error of the mean of gains ``[..., S]``; 0 of a single draw."""
    parts = valued.independent(gain)
    number = parts.shape[-1]
    return parts.std(-1) / number**0.5 if number > 1 else torch.zeros_like(gain[..., 0])


def least_gains(valued: Valued, gains: Tensor, standard_errors: float) -> Tensor:
    """Return lower bounds ``[...]`` of mean gains ``[..., S]``: mean - ``standard_errors`` * SE."""
    return valued.independent(gains).mean(-1) - standard_errors * standard_error(valued, gains)


def gain_over_silence(valued: Valued, index: int) -> Gain:
    """Return the gain of a candidate over silence."""
    gain = valued.utility[index] - valued.utility[0]
    parts = valued.independent(gain)
    error = float(standard_error(valued, gain))
    return Gain(float(parts.mean()), error, float((gain > TIE).float().mean()), len(parts))

"""The contract of a domain: what can be seen, said and done, and how the world moves.

A domain is a set of pure, batched functions over tensors. Nothing in it holds state between calls
and randomness enters only through the generator that is passed in, so one seed gives one rollout.

Shape letters, used in every docstring of the package:

===  ==========================================================================================
P    people
B    rounds (episodes) of a person, or a batch of rounds
T    steps of a round; a round holds T + 1 observations, T actions and T rewards
K    items of a modality (cars that can be shown, utterances that can be said)
F    features of an item
E    features of the ego, which are always known
Z    latent dimensions
A    actions
S    posterior draws
V    views of a round: the distinct ways to have seen it
===  ==========================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import torch
from torch import Tensor

from mirror_ppl.domains.record import Record
from mirror_ppl.errors import UnknownNameError

Observation = Mapping[str, Tensor]
"""Values by name: ``"ego"`` ``[..., E]`` and one entry ``[..., K, F]`` for each modality."""


class RepeatedObservation(Mapping[str, Tensor]):
    """Observations ``[n, ...]``, many of them the same; copied only where they are read.

    Args:
        distinct: observations ``[rows, ...]``.
        row: which of them each is ``[n]``.
    """

    def __init__(self, distinct: Observation, row: Tensor) -> None:
        self.distinct, self.row = distinct, row
        self._read: dict[str, Tensor] = {}

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._read:
            self._read[name] = self.distinct[name][self.row]
        return self._read[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.distinct)

    def __len__(self) -> int:
        return len(self.distinct)


def of_each(function: Callable[[Observation], Tensor], observation: Observation) -> Tensor:
    """A function of each observation, called once where many are the same."""
    if isinstance(observation, RepeatedObservation):
        return function(observation.distinct)[observation.row]
    return function(observation)


Visibility = dict[str, Tensor]
"""Masks by modality, boolean ``[..., K]``: which items are seen (or were communicated)."""


@dataclass(frozen=True)
class Modality:
    """A channel through which items can be observed and communicated.

    Args:
        name: name of the channel, a key of observations and visibilities.
        items: names of its K items.
        features: names of the F features of an item.
        units: unit of each feature.
        scales: typical size of each feature, by which decoders normalize.
        cost_coefficient: communicating n items in one step costs ``cost_coefficient * n**2``
            units of reward (supplement, Table I).
        image: rows, columns and colours of an item that is an image; its features are the pixels
            in that order.
        utterances: of spoken items, what is said of each by the value of its one feature: U
            sentences an item, for the values 0 to U - 1.
    """

    name: str
    items: tuple[str, ...]
    features: tuple[str, ...]
    units: tuple[str, ...]
    scales: tuple[float, ...]
    cost_coefficient: float
    image: tuple[int, int, int] | None = None
    utterances: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        if not len(self.features) == len(self.units) == len(self.scales):
            raise ValueError(f"modality {self.name!r}: each feature needs a unit and a scale")
        if self.image is not None and math.prod(self.image) != len(self.features):
            raise ValueError(f"modality {self.name!r}: an image's features are its pixels")
        if self.utterances and len(self.utterances) != len(self.items):
            raise ValueError(
                f"modality {self.name!r}: each item needs a tuple of its utterances, expected "
                f"{len(self.items)}, found {len(self.utterances)}"
            )

    def cost(self, number: Tensor) -> Tensor:
        """Cost in units of reward of communicating ``number`` items in one step."""
        return self.cost_coefficient * number.to(torch.get_default_dtype()) ** 2

    def understand(self, utterance: str) -> tuple[int, int]:
        """Which item an utterance is about, and which of the utterances about it was said.

        Args:
            utterance: one of ``utterances``; upper and lower case count alike.

        Raises:
            UnknownNameError: it is none of them; lists them.
            TypeError: it is no string.
        """
        if not isinstance(utterance, str):
            raise TypeError(f"an utterance is a string, not {utterance!r}")
        known = [sentence for about in self.utterances for sentence in about]
        alike = {sentence.lower(): place for place, sentence in enumerate(known)}
        heard = " ".join(utterance.lower().split())
        if heard not in alike:
            raise UnknownNameError.of("utterance", utterance, known)
        return divmod(alike[heard], len(self.utterances[0]))


class Domain(Protocol):
    """What a world offers to models, people, inference and communication.

    ``state`` and ``knowledge`` are the domain's own frozen dataclasses of tensors; only the domain
    looks inside. Knowledge is what an observer has learned of the things behind the items from what
    they saw or were told in a round so far. ``over_at_horizon`` says that nothing is left to win or
    lose when a round ends; where it does not, the end is only where recording stops.
    ``partial_views`` are reaches in each direction by name, in which self-models are measured.
    The robot practises to see only so far with weights ``reach_practice`` of the reaches (all alike
    if empty), to notice what is within reach at a step with a probability between those of
    ``notice_practice``, and to be told of an item with one up to ``told_practice``.
    ``assumptions`` are what an observer may take for granted of what they do not know; where all of
    them leave nothing open, the world is ``settled``.
    ``mishap`` is the reward term of what people should be kept from, and what several of them are
    called. ``counterparts`` has for each visual item the verbal item that tells of the same, where
    that tells more of it. ``record`` is what other parts of the package do differently here.
    """

    name: str
    version: str
    record: Record
    modalities: tuple[Modality, ...]
    ego_features: tuple[str, ...]
    symbol_sizes: Mapping[str, int]
    actions: tuple[str, ...]
    horizon: int
    over_at_horizon: bool
    settings: tuple[str, ...]
    scenarios: tuple[str, ...]
    reward_terms: tuple[str, ...]
    mishap: tuple[str, str]
    counterparts: tuple[int | None, ...]
    directions: tuple[str, ...]
    direction_groups: tuple[tuple[int, ...], ...]
    reach_bins: tuple[float, ...]
    reach_unit: str
    reach_practice: tuple[float, ...]
    told_practice: float
    notice_practice: tuple[float, float]
    partial_views: Mapping[str, tuple[float, ...]]
    assumptions: tuple[str, ...]
    settled: bool

    @property
    def as_believed(self) -> Domain:
        """The world as the robot was taught it, which may be wrong; else the world itself."""
        ...

    def initial(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> Any:
        """States ``[batch]`` at the start of a round, scenarios drawn uniformly unless given."""
        ...

    def anywhere(self, batch: int, generator: torch.Generator) -> Any:
        """States ``[batch]`` from which the robot learns, wherever a round may lead to."""
        ...

    def transition(self, state: Any, action: Tensor) -> Any:
        """State at t + 1 from the state at t and the action at t, both batched alike."""
        ...

    def rewards(self, state: Any, action: Tensor, following: Any) -> dict[str, Tensor]:
        """Reward terms by name, each ``[...]``; the task reward is their sum."""
        ...

    def over(self, state: Any) -> Tensor:
        """Where ``[...]`` all is done, and nothing can be won or lost any more."""
        ...

    def observe(self, state: Any) -> Observation:
        """Everything that could be observed of a state, whoever looks."""
        ...

    def visibility(self, setting: str, observation: Observation) -> Visibility:
        """What an unaided person sees in a setting, limited by the setting alone."""
        ...

    def communicable(self, observation: Observation) -> Visibility:
        """Which items may be communicated now."""
        ...

    def faults(self, observation: Observation) -> dict[str, Tensor]:
        """What cannot be in this world: which observations ``[...]`` break each rule, by rule."""
        ...

    def nothing_known(self, *batch: int, device: torch.device | None = None) -> Any:
        """Knowledge ``[*batch]`` before anything was observed."""
        ...

    def learn(
        self,
        knowledge: Any,
        observation: Observation,
        visible: Visibility,
        sees: Callable[[Observation], Visibility],
    ) -> Any:
        """Knowledge ``[...]`` after a step, from that of the step before.

        Args:
            knowledge: of the step before.
            observation: everything there is to observe at this step ``[..., K, F]``.
            visible: which items are seen or told at this step ``[..., K]``.
            sees: which items of an observation the observer would see by themselves; it tells
                whether something that they expected is missing.
        """
        ...

    def known(self, knowledge: Any) -> Visibility:
        """Items ``[..., K]`` whose content follows from what was observed, at this step or before.

        As the supplement has it (section B), what was seen or told is digested and not forgotten.
        """
        ...

    def assume(
        self, knowledge: Any, observation: Observation
    ) -> tuple[dict[str, Visibility], Observation]:
        """What somebody may take for granted about the things that they do not know.

        Args:
            knowledge: what they have learned.
            observation: of this step; only what is always known of it is used.

        Returns:
            For each of ``assumptions``, the items ``[..., K]`` that it is about; and the
            observation ``[..., K, F]`` in which those items are as assumed.
        """
        ...

    def supposed(self, state: Any, knowledge: Any, assumes: Mapping[str, Tensor]) -> Any:
        """The state as somebody believes it to be who makes some of the assumptions.

        Args:
            state: how it is.
            knowledge: what they have learned.
            assumes: for each of ``assumptions``, who makes it, boolean ``[...]``.
        """
        ...

    def symbols(self, observation: Observation) -> dict[str, Tensor]:
        """Observations in the form in which networks read them, ``[..., symbol_sizes[name]]``."""
        ...

    def distance(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """What perceptual implants act on: direction index and distance of each visual item."""
        ...

    def state_behind(self, observation: Observation) -> Any:
        """The state ``[...]`` that gives this observation of everything."""
        ...

    def next_observation(self, observation: Observation, action: Tensor) -> Observation:
        """What there is to observe after an action ``[...]``; NaN where it may be one or another.

        Recordings are held against it, see :mod:`mirror_ppl.data.contradictions`.
        """
        ...

    def nearest(self, observation: Observation) -> Observation:
        """The possible observation ``[...]`` nearest to one that decoders came up with."""
        ...

    def relevance(self, observation: Observation) -> dict[str, Visibility]:
        """Which items ``[..., K]`` are about what matters now, by notion of what that is.

        The first notion is the one of the supplement, section F.
        """
        ...

    def decisive(self, observation: Observation) -> Visibility:
        """The items ``[..., K]`` that somebody has to know to choose as who knows everything.

        Too many do no harm. Self-models learn exact values where these are known.
        """
        ...

    def describe(self, observation: Observation, modality: str, item: str) -> str:
        """An item of one observation ``[K, F]`` in words, such as "rear car, closing"."""
        ...

    def deed(self, observation: Observation, item: str | None, action: int) -> str:
        """An action in words, with regard to an item (now) or none, such as "switch lanes"."""
        ...

    def reference_values(self, state: Any, discount: float) -> Tensor:
        """Exact discounted action values ``[..., A]`` of a fully known state."""
        ...

    def render(self, state: Any) -> Any:
        """A picture of one state, ``uint8 [height, width, 3]``."""
        ...


def total_reward(terms: Mapping[str, Tensor]) -> Tensor:
    """Sum of reward terms ``[...]``."""
    return torch.stack(list(terms.values())).sum(0)


def map_state(function: Callable[..., Tensor], *states: Any) -> Any:
    """Apply a function to each tensor of one or several states, or of any dataclass of tensors."""
    kind = type(states[0])
    return kind(
        **{
            field.name: function(*(getattr(state, field.name) for state in states))
            for field in fields(kind)
        }
    )


def roll_out(domain: Domain, start: Any, actions: Tensor) -> Any:
    """States ``[B, T + 1]`` of rounds from ``start`` ``[B]`` under ``actions`` ``[B, T]``."""
    states = [start]
    for action in actions.unbind(1):
        states.append(domain.transition(states[-1], action))
    return map_state(lambda *parts: torch.stack(parts, 1), *states)


def require_known(name: str, kind: str, known: Sequence[str], where: str = "") -> str:
    """Return ``name`` if it is one of ``known``, in the domain ``where``.

    Raises:
        UnknownNameError: listing the known names.
    """
    if not isinstance(name, str) or name not in known:
        raise UnknownNameError.of(kind, name, known, where)
    return name


def by_eye(domain: Domain, seen: Tensor) -> Visibility:
    """What somebody sees who hears nothing: visual items ``[..., K]``, and none of the others."""
    return {
        modality.name: seen
        if modality.name == "visual"
        else torch.zeros(
            *seen.shape[:-1], len(modality.items), dtype=torch.bool, device=seen.device
        )
        for modality in domain.modalities
    }

"""The contract of a domain: observations, messages, actions and dynamics.

A domain is a set of pure, batched functions over tensors. It holds no state between calls, and
randomness enters only through the generator that is passed in, so one seed gives one rollout.

Shape letters, used in every docstring of the package:

===  ==========================================================================================
P    people
B    rounds (episodes) of a person, or a batch of rounds
T    steps of a round; a round holds T + 1 observations, T actions and T rewards
K    items of a modality (cars that can be shown, utterances that can be said)
F    features of an item
E    features of the ego, which are always observed
Z    latent dimensions
A    actions
S    posterior draws
V    distinct views of a round
===  ==========================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any, Protocol

import torch
from torch import Tensor

from mirror_ppl.domains.controls import Control
from mirror_ppl.domains.modality import Modality
from mirror_ppl.domains.record import Record
from mirror_ppl.errors import UnknownNameError

Observation = Mapping[str, Tensor]
"""Values by name: ``"ego"`` ``[..., E]`` and one entry ``[..., K, F]`` for each modality."""


class RepeatedObservation(Mapping[str, Tensor]):
    """Observations ``[n, ...]`` with many repeated rows; copied only when read.

    Args:
        distinct: observations ``[rows, ...]``.
        row: index of each among them ``[n]``.
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
    """Apply a function to each observation, to repeated rows only once."""
    if isinstance(observation, RepeatedObservation):
        return function(observation.distinct)[observation.row]
    return function(observation)


Visibility = dict[str, Tensor]
"""Masks by modality, boolean ``[..., K]``: items that are seen (or communicated)."""


FUTURES = 8
"""Number of futures that are averaged over in random worlds."""


class Domain(Protocol):
    """The interface of a world for models, people, inference and communication.

    ``state`` and ``knowledge`` are the domain's own frozen dataclasses of tensors, opaque to other
    code. Knowledge is what an observer has learned about the hidden state behind the items from
    what they saw and heard in a round so far. ``over_at_horizon`` is true if nothing can be won or
    lost after the end of a round; otherwise recording merely stops there. ``partial_views`` are
    reaches in each direction by name, with which self-models are evaluated. In training, the
    robot's reach is drawn with weights ``reach_practice`` (uniform if empty), items within reach
    are noticed with a probability per step drawn between those of ``notice_practice``, and items
    are communicated with a probability of up to ``told_practice``. What was observed before is read
    only in assumptions, not in `known`, unless the world ``recalls``. ``assumptions`` are what an
    observer may take for granted about unknown items; the world is ``settled`` if all of them
    together determine every item. ``mishap`` is the reward term of a harmful event, and the plural
    of its name. ``counterparts`` has for each visual item the verbal item about the same thing, if
    that is more informative. ``record`` holds settings of other parts of the package. In a world
    that is ``partly_observed``, observations do not determine states, and `state_behind` estimates.
    States of ``random`` worlds hold a seed of what will happen by chance; `state_behind` takes any.
    ``controls`` are what people set where actions are continuous; ``actions`` are then a grid of
    their values. `transition`, `rewards` and `next_observation` also take what was executed:
    control values ``[..., C]`` of numbers with a point.
    """

    name: str
    version: str
    record: Record
    modalities: tuple[Modality, ...]
    ego_features: tuple[str, ...]
    symbol_sizes: Mapping[str, int]
    actions: tuple[str, ...]
    controls: tuple[Control, ...]
    horizon: int
    over_at_horizon: bool
    settings: tuple[str, ...]
    scenarios: tuple[str, ...]
    reward_terms: tuple[str, ...]
    mishap: tuple[str, str]
    picture_legend: str
    counterparts: tuple[int | None, ...]
    directions: tuple[str, ...]
    direction_groups: tuple[tuple[int, ...], ...]
    reach_bins: tuple[float, ...]
    reach_unit: str
    reach_practice: tuple[float, ...]
    told_practice: float
    recalls: bool
    notice_practice: tuple[float, float]
    partial_views: Mapping[str, tuple[float, ...]]
    assumptions: tuple[str, ...]
    settled: bool
    partly_observed: bool
    random: bool

    @property
    def as_believed(self) -> Domain:
        """World as the robot was taught it, which may be wrong; else the world itself."""
        ...

    def initial(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> Any:
        """Draw states ``[batch]`` at the start of a round; scenarios uniformly unless given."""
        ...

    def anywhere(self, batch: int, generator: torch.Generator) -> Any:
        """Draw states ``[batch]`` for the robot's training, anywhere a round may lead."""
        ...

    def transition(self, state: Any, action: Tensor) -> Any:
        """Return the state at t + 1 from the state and action at t, batched alike."""
        ...

    def rewards(self, state: Any, action: Tensor, following: Any) -> dict[str, Tensor]:
        """Return reward terms by name, each ``[...]``; the task reward is their sum."""
        ...

    def redrawn(self, state: Any, generator: torch.Generator) -> Any:
        """Return states ``[...]`` that differ in what will happen by chance alone."""
        ...

    def over(self, state: Any) -> Tensor:
        """Return where ``[...]`` the task is done and no more reward can be won or lost."""
        ...

    def observe(self, state: Any) -> Observation:
        """Return the full observation of a state."""
        ...

    def visibility(self, setting: str, observation: Observation) -> Visibility:
        """Return the items that an unaided person sees, limited by the setting alone."""
        ...

    def communicable(self, observation: Observation) -> Visibility:
        """Return the items that may be communicated now."""
        ...

    def faults(self, observation: Observation) -> dict[str, Tensor]:
        """Return which observations ``[...]`` break each rule of this world, by rule."""
        ...

    def nothing_known(self, *batch: int, device: torch.device | None = None) -> Any:
        """Return knowledge ``[*batch]`` before anything was observed."""
        ...

    def learn(
        self,
        knowledge: Any,
        observation: Observation,
        visible: Visibility,
        sees: Callable[[Observation], Visibility],
    ) -> Any:
        """Return knowledge ``[...]`` after a step.

        Args:
            knowledge: of the step before.
            observation: full observation of this step ``[..., K, F]``.
            visible: items that are seen or communicated at this step ``[..., K]``.
            sees: maps an observation to the items the observer would see without messages, to
                detect that an expected item is missing.
        """
        ...

    def known(self, knowledge: Any) -> Visibility:
        """Return items ``[..., K]`` whose content follows from observations so far.

        As in the supplement (section B), what was seen or communicated is not forgotten.
        """
        ...

    def assume(
        self, knowledge: Any, observation: Observation
    ) -> tuple[dict[str, Visibility], Observation]:
        """Return what a person may take for granted about unknown items.

        Args:
            knowledge: what they have learned.
            observation: of this step; only its always observed parts are used.

        Returns:
            For each of ``assumptions``, the items ``[..., K]`` that it is about; and the
            observation ``[..., K, F]`` in which those items are as assumed.
        """
        ...

    def supposed(self, state: Any, knowledge: Any, assumes: Mapping[str, Tensor]) -> Any:
        """Return the state as believed by a person who makes some of the assumptions.

        Args:
            state: the true state.
            knowledge: what they have learned.
            assumes: for each of ``assumptions``, whether they make it, boolean ``[...]``.
        """
        ...

    def symbols(self, observation: Observation) -> dict[str, Tensor]:
        """Encode observations for networks, ``[..., symbol_sizes[name]]``.

        The symbols of an item depend on that item and the ego only.
        """
        ...

    def distance(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Return the direction index and distance of each visual item, for perceptual implants."""
        ...

    def state_behind(self, observation: Observation) -> Any:
        """Return the state ``[...]`` with this full observation."""
        ...

    def nothing_new(self, observation: Observation) -> Tensor | None:
        """Return steps ``[T + 1]`` at which who sees everything keeps their belief; None: none."""
        ...

    def ended(self, observation: Observation) -> Tensor:
        """Return where ``[...]`` the task is certainly done, so that rounds end there."""
        ...

    def next_observation(self, observation: Observation, action: Tensor) -> Observation:
        """Return the full observation after an action ``[...]``; NaN where it is random.

        Recordings are checked against it, see :mod:`mirror_ppl.data.contradictions`.
        """
        ...

    def possible_rewards(self, observation: Observation, action: Tensor) -> Tensor | None:
        """Return the rewards ``[..., R]`` that recordings may have, or None if any may occur.

        Args:
            observation: the full observation ``[..., K, F]`` before the action.
            action: ``[...]``.
        """
        ...

    def nearest(self, observation: Observation) -> Observation:
        """Return the possible observation ``[...]`` nearest to a decoded one."""
        ...

    def relevance(self, observation: Observation) -> dict[str, Visibility]:
        """Return relevant items ``[..., K]``, by definition of relevance.

        The first definition is that of the supplement, section F.
        """
        ...

    def decisive(self, observation: Observation) -> Visibility:
        """Return items ``[..., K]`` that suffice for the choice made with full knowledge.

        A superset is fine. Self-models learn exact values where these items are known.
        """
        ...

    def describe(self, observation: Observation, modality: str, item: str) -> str:
        """Describe an item of one observation ``[K, F]``, such as "rear car, closing"."""
        ...

    def deed(self, observation: Observation, item: str | None, action: int) -> str:
        """Describe an action, relative to a present item or none, such as "switch lanes"."""
        ...

    def reference_values(self, state: Any, discount: float) -> Tensor:
        """Return exact discounted action values ``[..., A]`` of a fully known state."""
        ...

    def render(self, state: Any) -> Any:
        """Draw a picture of one state, ``uint8 [height, width, 3]``."""
        ...

    def render_seen(self, state: Any, visible: Visibility) -> Any:
        """Draw one state as a person perceives it, to whom the items ``[K]`` are visible."""
        ...


def total_reward(terms: Mapping[str, Tensor]) -> Tensor:
    """Return the sum of reward terms ``[...]``."""
    return torch.stack(list(terms.values())).sum(0)


def map_state(function: Callable[..., Tensor], *states: Any) -> Any:
    """Apply a function to each tensor of states, or of any dataclass of tensors or of such."""
    if isinstance(states[0], Tensor):
        return function(*states)
    kind = type(states[0])
    return kind(
        **{
            field.name: map_state(function, *(getattr(state, field.name) for state in states))
            for field in fields(kind)
        }
    )


def tensors_of(state: Any) -> list[Tensor]:
    """Return the tensors of a dataclass of tensors, or of such, in the order of its fields."""
    if isinstance(state, Tensor):
        return [state]
    return [part for field in fields(state) for part in tensors_of(getattr(state, field.name))]


def roll_out(domain: Domain, start: Any, actions: Tensor) -> Any:
    """Return states ``[B, T + 1]`` of rounds from ``start`` ``[B]`` by ``actions`` ``[B, T]``."""
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
    """Return masks with visual items ``[..., K]`` seen and no items of other modalities."""
    return {
        modality.name: seen
        if modality.name == "visual"
        else torch.zeros(
            *seen.shape[:-1], len(modality.items), dtype=torch.bool, device=seen.device
        )
        for modality in domain.modalities
    }

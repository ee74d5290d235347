"""Base class of worlds: a core to implement, and defaults for the rest of the interface.

The core is items and their features, actions, initial states, transitions, rewards and full
observations. Every other member of :class:`~mirror_ppl.domains.base.Domain` has a default here,
derived from the core; docstrings state what the default assumes. ``docs/adding_a_world.md`` is a
step-by-step guide.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility, require_known
from mirror_ppl.domains.controls import Control, grid
from mirror_ppl.domains.derived import VISUAL, complete
from mirror_ppl.domains.memory import LastSeen
from mirror_ppl.domains.modality import Modality
from mirror_ppl.domains.record import Record
from mirror_ppl.errors import DomainError

EVERYTHING = "anything"
"""Definition of relevance of worlds without one: all items are relevant."""
PIXELS = 24
"""Width and height of a number in the default picture."""
POSITIVE, NEGATIVE, BORDER = (0.0, 90.0, 180.0), (200.0, 90.0, 0.0), 128
"""Colours of the largest and of the least number in the default picture, and of borders."""
UNSEEN = 0.6
"""Factor on the brightness of items that a person does not see, in the default picture."""


class World(ABC):
    """Base class of a world; derive from it and implement the core.

    States are frozen dataclasses of tensors whose first dimensions are those of the batch. All
    methods are batched and pure: randomness is drawn only in `initial`, from its generator.

    Attributes:
        name: of the world; by default the class name in snake case, such as ``tea_kitchen`` for
            ``TeaKitchen``.
        version: raise it when recordings and self-models of the world no longer fit.
        modalities: channels; items of ``visual`` can be seen, those of others can be said.
        ego_features: names of features that people always know of themselves, at least one.
        actions: names of the actions; derived from ``controls`` where there are some.
        controls: what people set where actions are continuous, none by default. The robot plans
            with a grid of their values, which are the ``actions``; see :meth:`control_values`.
        horizon: steps of a round.
        settings: names of the settings, such as ``("clear", "fog")``.
        reward_terms: names of the terms that `rewards` returns.
        positions: features of visual items that are offsets from the person, in one unit. The
            largest of them is an item's distance, to which sight thresholds apply. Without any, all
            items are at distance 1.
        reach_bins: possible sight thresholds; whole numbers up to the largest scale of
            ``positions`` unless given. The last one is everything.
        levels: possible values of whole-number features, by name. Networks read such a feature
            one-hot, and others as a number in units of their scales.
        lasting: items that people remember once seen or communicated, even if they change; other
            items are known while they are as last seen.
        record: this world's settings of training, planning and networks, its people and pictures;
            see :class:`~mirror_ppl.domains.record.Record`.
        mishap: reward term of a harmful event, and the plural of its name.
        picture_legend: a sentence about pictures of states, which stands below films.
        partly_observed: True if full observations do not determine states; `state_behind` is then
            an estimate, as in ``random`` worlds.
        random: True if states hold a seed of what will happen by chance, which `transition` uses
            and replaces, and `redrawn` draws anew.
    """

    name: str
    version: str = "1"
    modalities: tuple[Modality, ...]
    ego_features: tuple[str, ...]
    actions: tuple[str, ...]
    horizon: int
    settings: tuple[str, ...] = ("everyday",)
    reward_terms: tuple[str, ...] = ("reward",)
    positions: tuple[str, ...] = ()
    reach_bins: tuple[float, ...]
    levels: Mapping[str, range] = {}
    controls: tuple[Control, ...] = ()
    lasting: tuple[str, ...] = ()
    record: Record = Record()
    mishap: tuple[str, str]
    picture_legend: str = ""
    partly_observed: bool = False
    random: bool = False

    scenarios: tuple[str, ...] = ("any",)
    over_at_horizon: bool = True
    directions: tuple[str, ...] = ("around",)
    direction_groups: tuple[tuple[int, ...], ...] = ((0,),)
    reach_unit: str
    reach_practice: tuple[float, ...] = ()
    told_practice: float = 0.3
    recalls: bool = True
    notice_practice: tuple[float, float] = (1.0, 1.0)
    partial_views: Mapping[str, tuple[float, ...]]
    assumptions: tuple[str, ...] = ()
    settled: bool = False
    reflected_actions: tuple[int, ...] = ()
    reflected_items: Mapping[str, tuple[int, ...]] = {}
    counterparts: tuple[int | None, ...]
    symbol_sizes: Mapping[str, int]
    _derived: frozenset[str]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Set derived attributes.

        Raises:
            DomainError: a required attribute is missing.
        """
        del args, kwargs
        if "_derived" not in vars(cls):
            cls._derived = complete(cls)
        return super().__new__(cls)

    @classmethod
    def given(cls, name: str) -> bool:
        """True if an attribute was given, not derived, in this class or a base class."""
        return any(
            name in vars(each) and name not in vars(each).get("_derived", ())
            for each in cls.__mro__
        )

    @classmethod
    def levels_of_features(cls) -> Mapping[str, Sequence[range | None]]:
        """Return the levels of each feature by modality; for utterances, the sentence indices."""
        return {"ego": [cls.levels.get(name) for name in cls.ego_features]} | {
            m.name: [range(len(m.utterances[0]))]
            if m.utterances
            else [cls.levels.get(name) for name in m.features]
            for m in cls.modalities
        }

    @abstractmethod
    def initial(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> Any:
        """Draw states ``[batch]`` at the start of a round, with the generator.

        A world with its own scenarios begins in those that are given ``[batch]``.
        """

    @abstractmethod
    def transition(self, state: Any, action: Tensor) -> Any:
        """Return the state at t + 1 from the state and action at t, both ``[...]``."""

    @abstractmethod
    def rewards(self, state: Any, action: Tensor, following: Any) -> dict[str, Tensor]:
        """Return reward terms ``[...]`` by name, in units of reward."""

    @abstractmethod
    def observe(self, state: Any) -> Observation:
        """Return the full observation: ``ego`` ``[..., E]``, each modality ``[..., K, F]``."""

    @abstractmethod
    def state_behind(self, observation: Observation) -> Any:
        """Return the state ``[...]`` with this full observation.

        Unobserved parts must not matter: states with equal observations lead to equal observations
        and rewards. In a world that is ``partly_observed`` this is an estimate.
        """

    def redrawn(self, state: Any, generator: torch.Generator) -> Any:
        """Return states ``[...]`` that differ in what will happen by chance alone: the same ones.

        Planning averages over such states in ``random`` worlds, which have to implement this.
        """
        del generator
        return state

    def control_values(self, action: Tensor) -> Tensor:
        """Return the values of the controls ``[..., C]`` of an action, for `transition`.

        Args:
            action: index ``[...]``, or the values themselves, ``[..., C]`` of numbers with a point.
        """
        if action.is_floating_point():
            return action
        return grid(self.controls).to(action.device)[action]

    def visibility(self, setting: str, observation: Observation) -> Visibility:
        """Return what an unaided person perceives ``[..., K]``: all visual items, no others."""
        require_known(setting, "setting", self.settings, self.name)
        return self._all(observation, lambda m: m.name == VISUAL)

    def scenario(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> Tensor:
        """Return indices ``[batch]`` into ``scenarios``: as given, or drawn uniformly."""
        if scenario is not None:
            return scenario
        many, device = len(self.scenarios), generator.device
        return torch.randint(many, (batch,), generator=generator, device=device)

    @property
    def as_believed(self) -> Self:
        """World as the robot was taught it: this world itself."""
        return self

    def anywhere(self, batch: int, generator: torch.Generator) -> Any:
        """Draw states ``[batch]`` for the robot's training: those in which rounds begin."""
        return self.initial(batch, generator)

    def over(self, state: Any) -> Tensor:
        """Return where ``[...]`` the task is done: nowhere before the horizon."""
        return torch.zeros_like(self.observe(state)["ego"][..., 0], dtype=torch.bool)

    def communicable(self, observation: Observation) -> Visibility:
        """Return items ``[..., K]`` that may be communicated: all."""
        return self._all(observation, lambda m: True)

    def own_faults(self) -> list[str]:
        """Return what is wrong with the world by checks of its own; `check_domain` prints it."""
        return []

    def faults(self, observation: Observation) -> dict[str, Tensor]:
        """Return impossible observations ``[...]``: those with a feature outside its levels."""
        found = {}
        names = {"ego": self.ego_features} | {m.name: m.features for m in self.modalities}
        for modality, levels in self.levels_of_features().items():
            for place, (feature, known) in enumerate(zip(names[modality], levels, strict=True)):
                if known is not None:
                    wrong = (observation[modality][..., place] - known[0]) / known.step
                    wrong = (wrong != wrong.round()) | (wrong < 0) | (wrong >= len(known))
                    rule = f"{feature} of {modality} has to be one of {list(known)}"
                    found[rule] = wrong if modality == "ego" else wrong.any(-1)
        return found

    def nothing_known(self, *batch: int, device: torch.device | None = None) -> Any:
        """Return knowledge ``[*batch]`` before anything was observed."""
        return LastSeen.nothing(self.modalities, *batch, device=device)

    def learn(
        self,
        knowledge: Any,
        observation: Observation,
        visible: Visibility,
        sees: Callable[[Observation], Visibility],
    ) -> Any:
        """Return knowledge ``[...]`` after a step: each item as last seen."""
        del sees
        return knowledge.after(self.modalities, self.lasting, observation, visible)

    def known(self, knowledge: Any) -> Visibility:
        """Return items ``[..., K]`` that are as last seen, and lasting items once seen."""
        return knowledge.items(self.modalities)

    def assume(
        self, knowledge: Any, observation: Observation
    ) -> tuple[dict[str, Visibility], Observation]:
        """Return what a person may take for granted: nothing."""
        del knowledge
        return {}, observation

    def supposed(self, state: Any, knowledge: Any, assumes: Mapping[str, Tensor]) -> Any:
        """Return the state as a person believes it to be: the true state."""
        del knowledge, assumes
        return state

    def reflected(self, state: Any) -> Any:
        """Return the mirror image of a state, in a world that equals its mirror image.

        A robot that learns values of a planner (``distil``) then learns from twice as many rounds.
        Such a world also has ``reflected_actions``, the index of each action's mirror image, and
        ``reflected_items``, those of the items of each modality.

        Raises:
            NotImplementedError: unless a world defines it.
        """
        raise NotImplementedError(f"{self.name} has no reflected()")

    def symbols(self, observation: Observation) -> dict[str, Tensor]:
        """Encode observations for networks, ``[..., K, symbol_sizes]``; see ``levels``."""
        scales = {"ego": (1.0,) * len(self.ego_features)}
        scales |= {m.name: m.scales for m in self.modalities}
        return {
            modality: torch.cat(
                [
                    _symbol(observation[modality][..., place], known, scales[modality][place])
                    for place, known in enumerate(levels)
                ],
                -1,
            )
            for modality, levels in self.levels_of_features().items()
        }

    def distance(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Return directions and distances ``[..., K]`` of visual items, from ``positions``."""
        items = observation[VISUAL]
        visual = next(m for m in self.modalities if m.name == VISUAL)
        if self.positions:
            places = [visual.features.index(name) for name in self.positions]
            far = items[..., places].abs().amax(-1)
        else:
            far = torch.ones_like(items[..., 0])
        return torch.zeros_like(far, dtype=torch.long), far

    def nothing_new(self, observation: Observation) -> Tensor | None:
        """Return steps ``[T + 1]`` at which who sees everything keeps their belief; None: none."""
        del observation
        return None

    def ended(self, observation: Observation) -> Tensor:
        """Return where ``[...]`` the task is done: `over`, but nowhere if ``partly_observed``."""
        if self.partly_observed:
            return torch.zeros_like(observation["ego"][..., 0], dtype=torch.bool)
        return self.over(self.state_behind(observation))

    def next_observation(self, observation: Observation, action: Tensor) -> Observation:
        """Return the full observation after an action ``[...]``; NaN where it is not determined."""
        if self.partly_observed or self.random:
            return {name: torch.full_like(part, math.nan) for name, part in observation.items()}
        return self.observe(self.transition(self.state_behind(observation), action))

    def possible_rewards(self, observation: Observation, action: Tensor) -> Tensor | None:
        """Return the rewards ``[..., R]`` that recordings may have: None, which is any.

        Worlds in which recorded rewards enter inference define it.
        """
        del observation, action

    def nearest(self, observation: Observation) -> Observation:
        """Return the possible observation nearest to a decoded one: features rounded to levels."""

        def possible(value: Tensor, known: range | None) -> Tensor:
            if known is None:
                return value
            place = ((value - known[0]) / known.step).round().clamp(0, len(known) - 1)
            return known[0] + place * known.step

        return {
            modality: torch.stack(
                [possible(observation[modality][..., i], each) for i, each in enumerate(levels)], -1
            )
            for modality, levels in self.levels_of_features().items()
        }

    def relevance(self, observation: Observation) -> dict[str, Visibility]:
        """Return relevant items ``[..., K]``: all."""
        return {EVERYTHING: self._all(observation, lambda m: True)}

    def decisive(self, observation: Observation) -> Visibility:
        """Return items ``[..., K]`` that suffice for the choice made with full knowledge: all."""
        return self._all(observation, lambda m: True)

    def describe(self, observation: Observation, modality: str, item: str) -> str:
        """Describe an item of one observation, such as "key: row 1 cells, column 3 cells"."""
        own = next(m for m in self.modalities if m.name == modality)
        groups = dict(own.groups)
        if item in groups:
            each = (self.describe(observation, modality, own.items[i]) for i in groups[item])
            return f"{item} ({'; '.join(each)})"
        place = own.items.index(item)
        if own.utterances:
            return own.utterances[place][round(float(observation[modality][place, 0]))]
        values = zip(own.features, observation[modality][place].tolist(), own.units, strict=True)
        return f"{item}: " + ", ".join(f"{name} {v:g} {unit}".strip() for name, v, unit in values)

    def deed(self, observation: Observation, item: str | None, action: int) -> str:
        """Describe an action: its name."""
        del observation, item
        return self.actions[action]

    def reference_values(self, state: Any, discount: float) -> Tensor:
        """Return exact discounted action values ``[..., A]``, if a world implements them."""
        raise DomainError(f"{self.name} has no exact action values (reference_values)")

    def render(self, state: Any) -> np.ndarray:
        """Draw ``uint8 [height, width, 3]``: a row per item, a column per feature.

        Positive numbers are blue, negative ones orange, larger ones darker; 0 is white.
        """
        visual = next(m for m in self.modalities if m.name == VISUAL)
        items = self.observe(state)[VISUAL].reshape(len(visual.items), -1)
        share = (items / torch.tensor(visual.scales)).clamp(-1, 1)[..., None]
        full = torch.where(share > 0, torch.tensor(POSITIVE), torch.tensor(NEGATIVE))
        colours = (255 + share.abs() * (full - 255)).round().to(torch.uint8).numpy()
        picture = colours.repeat(PIXELS, 0).repeat(PIXELS, 1)
        picture[::PIXELS] = picture[PIXELS - 1 :: PIXELS] = BORDER
        picture[:, ::PIXELS] = picture[:, PIXELS - 1 :: PIXELS] = BORDER
        return picture

    def render_seen(self, state: Any, visible: Visibility) -> np.ndarray:
        """Draw a state as a person perceives it who sees items ``[K]``.

        The default is `render`; of worlds without their own `render`, unseen items are darkened.
        """
        picture = self.render(state)
        if offers(self, "render"):
            return picture
        unseen = ~visible[VISUAL].numpy().repeat(PIXELS)
        picture[unseen] = (UNSEEN * picture[unseen]).astype(np.uint8)
        return picture

    def _all(self, observation: Observation, which: Callable[[Modality], bool]) -> Visibility:
        """Return masks ``[..., K]``, constant in each modality."""
        return {
            m.name: torch.full_like(observation[m.name][..., 0], which(m), dtype=torch.bool)
            for m in self.modalities
        }


def _symbol(value: Tensor, levels: range | None, scale: float) -> Tensor:
    """Encode a feature for networks ``[..., L]``: one-hot levels, or one scaled number."""
    if levels is None:
        return value[..., None] / scale
    known = torch.tensor(list(levels), device=value.device)
    return (value[..., None] == known).to(value.dtype)


def offers(domain: Any, capability: str) -> bool:
    """True if a world has its own method or attribute, not the default of `World`."""
    return getattr(type(domain), capability, None) != getattr(World, capability, None)

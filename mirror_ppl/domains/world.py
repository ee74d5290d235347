"""The base of a world in one file: a core that has to be written, and defaults for all the rest.

The core is what only its author knows: items and their features, actions, how a round begins, how
the world moves, rewards, and what there is to observe. Everything else that a
:class:`~mirror_ppl.domains.base.Domain` offers has a default here, made of the core; docstrings say
what it takes for granted, and overriding it says more. ``docs/adding_a_world.md`` goes through it
step by step.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from mirror_ppl.domains.base import Modality, Observation, Visibility, require_known
from mirror_ppl.domains.memory import LastSeen
from mirror_ppl.domains.record import Record
from mirror_ppl.errors import DomainError

PIXELS = 24
"""Width and height of a number in the default picture."""
VISUAL = "visual"


class World(ABC):
    """A world of which only the core is written; derive from it.

    States are frozen dataclasses of tensors whose first dimensions are those of the batch. All
    methods are batched and pure: what is random is drawn in `initial`, from its generator.

    Attributes:
        name: of the world; that of the class in lower case unless given, as ``tea_kitchen`` of
            ``TeaKitchen``.
        version: raise it when recordings and self-models of the world no longer fit.
        modalities: channels; the one called ``visual`` is what can be seen, others can be said.
        ego_features: names of what people always know of their own situation, at least one.
        actions: names of what can be done.
        horizon: steps of a round.
        settings: names of the settings, such as ``("clear", "fog")``.
        reward_terms: names of the terms of which `rewards` returns the amounts.
        positions: features of visual items that are offsets from the person, in one unit. The
            largest of them is the distance of an item, on which thresholds of sight act. Without
            any, all items are at distance 1.
        reach_bins: distances of which one is somebody's threshold of sight; whole numbers up to the
            largest scale of ``positions`` unless given. The last one is everything.
        levels: of features that are whole numbers, which they can be, by name. Networks read such a
            feature as one number for each level, and others as a number in units of their scales.
        lasting: items that people keep in mind once they were seen or told of, however these
            change; others are known where they are as they were last seen.
        record: settings of training, planning and networks, people and pictures of this world's
            own; see :class:`~mirror_ppl.domains.record.Record`.
        mishap: reward term of what people should be kept from, and what several are called.
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
    lasting: tuple[str, ...] = ()
    record: Record = Record()
    mishap: tuple[str, str]

    scenarios: tuple[str, ...] = ("any",)
    over_at_horizon: bool = True
    directions: tuple[str, ...] = ("around",)
    direction_groups: tuple[tuple[int, ...], ...] = ((0,),)
    reach_unit: str
    reach_practice: tuple[float, ...] = ()
    told_practice: float = 0.3
    notice_practice: tuple[float, float] = (1.0, 1.0)
    partial_views: Mapping[str, tuple[float, ...]]
    assumptions: tuple[str, ...] = ()
    settled: bool = False
    counterparts: tuple[int | None, ...]
    symbol_sizes: Mapping[str, int]
    _derived: frozenset[str]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Work out what follows from the rest.

        Raises:
            DomainError: something that only the author can know is missing.
        """
        del args, kwargs
        cls._complete()
        return super().__new__(cls)

    @classmethod
    def _complete(cls) -> None:
        if "_derived" in vars(cls):
            return
        for name in ("modalities", "ego_features", "actions", "horizon"):
            if not hasattr(cls, name):
                raise DomainError(f"{cls.__name__} needs {name}; see docs/adding_a_world.md")
        visual = [m for m in cls.modalities if m.name == VISUAL]
        if len(visual) != 1:
            names = ", ".join(m.name for m in cls.modalities) or "none"
            raise DomainError(f'{cls.__name__}: one modality has to be "{VISUAL}", found {names}')
        features = visual[0].features
        for name in cls.positions:
            require_known(name, "position", features, cls.__name__)
        sizes = [visual[0].scales[features.index(name)] for name in cls.positions]
        units = {visual[0].units[features.index(name)] for name in cls.positions}
        bins = tuple(float(number) for number in range(int(max(sizes, default=1)) + 1))
        made: dict[str, Any] = {
            "name": re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower(),
            "reach_bins": bins,
            "reach_unit": units.pop() if len(units) == 1 else "steps",
            "mishap": (cls.reward_terms[0], f"steps with less {cls.reward_terms[0]} than 0"),
            "counterparts": (None,) * len(visual[0].items),
            "symbol_sizes": {
                name: sum(len(levels or (0,)) for levels in each)
                for name, each in cls._levels().items()
            },
        }
        derived = [name for name in made if not cls._given(name)]
        for name in derived:
            setattr(cls, name, made[name])
        if not cls._given("partial_views"):
            middle = cls.reach_bins[len(cls.reach_bins) // 2]
            cls.partial_views = {"half_the_reach": (middle,) * len(cls.directions)}
            derived.append("partial_views")
        cls._derived = frozenset(derived)

    @classmethod
    def _given(cls, name: str) -> bool:
        """Whether an attribute was written, and not worked out, in this class or one above."""
        return any(
            name in vars(each) and name not in vars(each).get("_derived", ())
            for each in cls.__mro__
        )

    @classmethod
    def _levels(cls) -> Mapping[str, Sequence[range | None]]:
        """The levels of each feature, by modality; of what is said, the sentences' numbers."""
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
        """States ``[batch]`` at the start of a round, drawn with the generator.

        With scenarios of its own, a world begins in those that are given ``[batch]``.
        """

    @abstractmethod
    def transition(self, state: Any, action: Tensor) -> Any:
        """State at t + 1 from the state at t and the action at t, both ``[...]``."""

    @abstractmethod
    def rewards(self, state: Any, action: Tensor, following: Any) -> dict[str, Tensor]:
        """Reward terms ``[...]`` by name, in units of reward."""

    @abstractmethod
    def observe(self, state: Any) -> Observation:
        """All that there is to observe: ``ego`` ``[..., E]``, each modality ``[..., K, F]``."""

    @abstractmethod
    def state_behind(self, observation: Observation) -> Any:
        """The state ``[...]`` of which this is everything that can be observed.

        What cannot be observed must not matter: states with the same observation lead to the same
        observations and rewards.
        """

    def visibility(self, setting: str, observation: Observation) -> Visibility:
        """What an unaided person sees ``[..., K]``: everything, and nothing is said to them."""
        require_known(setting, "setting", self.settings, self.name)
        return self._all(observation, lambda m: m.name == VISUAL)

    def scenario(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> Tensor:
        """Indices ``[batch]`` into ``scenarios``: those that are given, or drawn uniformly."""
        if scenario is not None:
            return scenario
        many, device = len(self.scenarios), generator.device
        return torch.randint(many, (batch,), generator=generator, device=device)

    @property
    def as_believed(self) -> Self:
        """The world itself: the robot was taught how it is."""
        return self

    def anywhere(self, batch: int, generator: torch.Generator) -> Any:
        """States ``[batch]`` from which the robot learns: those in which rounds begin."""
        return self.initial(batch, generator)

    def over(self, state: Any) -> Tensor:
        """Where ``[...]`` all is done: nowhere before the horizon."""
        return torch.zeros_like(self.observe(state)["ego"][..., 0], dtype=torch.bool)

    def communicable(self, observation: Observation) -> Visibility:
        """Which items ``[..., K]`` may be communicated: all."""
        return self._all(observation, lambda m: True)

    def faults(self, observation: Observation) -> dict[str, Tensor]:
        """Which observations ``[...]`` cannot be: of features with levels those without one."""
        found = {}
        names = {"ego": self.ego_features} | {m.name: m.features for m in self.modalities}
        for modality, levels in self._levels().items():
            for place, (feature, known) in enumerate(zip(names[modality], levels, strict=True)):
                if known is not None:
                    wrong = (observation[modality][..., place] - known[0]) / known.step
                    wrong = (wrong != wrong.round()) | (wrong < 0) | (wrong >= len(known))
                    rule = f"{feature} of {modality} has to be one of {list(known)}"
                    found[rule] = wrong if modality == "ego" else wrong.any(-1)
        return found

    def nothing_known(self, *batch: int, device: torch.device | None = None) -> Any:
        """Knowledge ``[*batch]`` before anything was observed."""
        return LastSeen.nothing(self.modalities, *batch, device=device)

    def learn(
        self,
        knowledge: Any,
        observation: Observation,
        visible: Visibility,
        sees: Callable[[Observation], Visibility],
    ) -> Any:
        """Knowledge ``[...]`` after a step: what was last seen of each item."""
        del sees
        return knowledge.after(self.modalities, self.lasting, observation, visible)

    def known(self, knowledge: Any) -> Visibility:
        """Items ``[..., K]`` that are as they were last seen, and the lasting ones once seen."""
        return knowledge.items(self.modalities)

    def assume(
        self, knowledge: Any, observation: Observation
    ) -> tuple[dict[str, Visibility], Observation]:
        """What somebody may take for granted: nothing."""
        del knowledge
        return {}, observation

    def supposed(self, state: Any, knowledge: Any, assumes: Mapping[str, Tensor]) -> Any:
        """The state as somebody believes it to be: as it is."""
        del knowledge, assumes
        return state

    def symbols(self, observation: Observation) -> dict[str, Tensor]:
        """Observations as networks read them, ``[..., K, symbol_sizes]``; see ``levels``."""
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
            for modality, levels in self._levels().items()
        }

    def distance(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Direction and distance ``[..., K]`` of visual items: the largest of ``positions``."""
        items = observation[VISUAL]
        visual = next(m for m in self.modalities if m.name == VISUAL)
        if self.positions:
            places = [visual.features.index(name) for name in self.positions]
            far = items[..., places].abs().amax(-1)
        else:
            far = torch.ones_like(items[..., 0])
        return torch.zeros_like(far, dtype=torch.long), far

    def next_observation(self, observation: Observation, action: Tensor) -> Observation:
        """What there is to observe after an action ``[...]``."""
        return self.observe(self.transition(self.state_behind(observation), action))

    def nearest(self, observation: Observation) -> Observation:
        """The possible observation nearest to a decoded one: features with levels take one."""

        def possible(value: Tensor, known: range | None) -> Tensor:
            if known is None:
                return value
            place = ((value - known[0]) / known.step).round().clamp(0, len(known) - 1)
            return known[0] + place * known.step

        return {
            modality: torch.stack(
                [possible(observation[modality][..., i], each) for i, each in enumerate(levels)], -1
            )
            for modality, levels in self._levels().items()
        }

    def relevance(self, observation: Observation) -> dict[str, Visibility]:
        """Items ``[..., K]`` that matter now: all, for all that is known here."""
        return {"anything": self._all(observation, lambda m: True)}

    def decisive(self, observation: Observation) -> Visibility:
        """Items ``[..., K]`` that have to be known to choose well: all."""
        return self._all(observation, lambda m: True)

    def describe(self, observation: Observation, modality: str, item: str) -> str:
        """An item of one observation in words, such as "key: row 1 cells, column 3 cells"."""
        own = next(m for m in self.modalities if m.name == modality)
        place = own.items.index(item)
        if own.utterances:
            return own.utterances[place][round(float(observation[modality][place, 0]))]
        values = zip(own.features, observation[modality][place].tolist(), own.units, strict=True)
        return f"{item}: " + ", ".join(f"{name} {v:g} {unit}".strip() for name, v, unit in values)

    def deed(self, observation: Observation, item: str | None, action: int) -> str:
        """An action in words: its name."""
        del observation, item
        return self.actions[action]

    def reference_values(self, state: Any, discount: float) -> Tensor:
        """Exact discounted action values ``[..., A]``; there are none unless a world has them."""
        raise DomainError(f"{self.name} has no exact action values (reference_values)")

    def render(self, state: Any) -> np.ndarray:
        """A picture ``uint8 [height, width, 3]``: items below each other, darker where more."""
        visual = next(m for m in self.modalities if m.name == VISUAL)
        items = self.observe(state)[VISUAL].reshape(len(visual.items), -1)
        share = (items / torch.tensor(visual.scales)).abs().clamp(0, 1)
        grey = (255 * (1 - share)).to(torch.uint8).numpy()
        return np.kron(grey, np.ones((PIXELS, PIXELS), np.uint8))[..., None].repeat(3, -1)

    def _all(self, observation: Observation, which: Callable[[Modality], bool]) -> Visibility:
        """Masks ``[..., K]``, all alike in each modality."""
        return {
            m.name: torch.full_like(observation[m.name][..., 0], which(m), dtype=torch.bool)
            for m in self.modalities
        }


def _symbol(value: Tensor, levels: range | None, scale: float) -> Tensor:
    """A feature as networks read it ``[..., L]``: one number for each level, or one in all."""
    if levels is None:
        return value[..., None] / scale
    known = torch.tensor(list(levels), device=value.device)
    return (value[..., None] == known).to(value.dtype)


def offers(domain: Any, capability: str) -> bool:
    """Whether a world has a method or attribute of its own, and not the default of `World`."""
    return getattr(type(domain), capability, None) != getattr(World, capability, None)

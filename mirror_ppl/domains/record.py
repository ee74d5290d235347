"""Records of worlds: settings, people, pictures and human models besides the rules."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from mirror_ppl.checks import real_number
from mirror_ppl.errors import DomainError

SQIL_IN_LONG_ROUNDS: Mapping[str, Any] = {
    "batch": 5,
    "sampled": 5,
    "kept": 50,
    "epochs": 1500,
    "check_every": 10,
    "patience": 60,
}
"""Settings of SQIL for long rounds: it takes many steps until it imitates what people do."""
LEAST_POWER = 0.001
"""Least power of the likelihood; at 0 recordings would say nothing."""
CONSISTENCY = 3.0
"""Prior median of consistency per unit of reward, unless a world has its own."""
CONSISTENCIES = 1e-6, 1e6
"""Least and largest prior median of consistency."""
LARGEST_ERROR = 1e6
"""Largest ``value_error``."""
LEAST_SIGHT_SCALE = 0.1
"""Least ``sight_scale``; below that, directions would be equal."""
PARTS = ("people", "human_models", "pictures", "rounds")
"""Attributes of a record that may be strings ``"module:name"``."""


@dataclass(frozen=True)
class Record:
    """Settings of other parts of the package for a world; all are optional.

    People, pictures and human models are objects or strings ``"module:name"``, so that a world can
    be loaded without them.

    Attributes:
        networks: :class:`~mirror_ppl.models.sizes.Sizes` of the robot that differ in this world.
        paper_networks: sizes that further differ in the supplement, where they cost too much.
        training: of :class:`~mirror_ppl.training.self_model_options.SelfModelOptions`, by name.
        planning: settings of :class:`~mirror_ppl.communication.planners.PlannerOptions`.
        baselines: settings of baselines, by the baseline's name: ``bc`` and ``sqil``.
        likelihood_power: power of the likelihood of recorded actions in posteriors. Below 1 it
            takes account of errors of the robot's values that are alike in successive decisions,
            which the model would otherwise take for evidence on a person.
        consistency: prior median of people's consistency, the inverse temperature of their choices
            per unit of reward (:func:`mirror_ppl.models.implants.choice_implants`).
        value_error: size of the errors of the robot's action values, in units of reward. People do
            not choose by differences to the best value that are far below it
            (:func:`mirror_ppl.models.value_errors.beyond_errors`); 0 if they choose by all.
        sight_scale: bins by which the prior ties how far people see in the directions of a group
            (``direction_groups``); None if it does not
            (:func:`mirror_ppl.models.implants.alike`).
        measured: rounds on which a self-model's returns and agreement are measured.
        slow: models that `evaluate` compares only on request, because they take minutes: `svi`
            with many values to sum over at each step, and SQIL with long rounds.
        people: the simulated people, a :class:`~mirror_ppl.people.base.DomainPeople`; those of
            :mod:`mirror_ppl.people.robot_like` unless given.
        human_models: classes of human models by name, which replace the package's or add others.
        pictures: of what people see, :class:`~mirror_ppl.plots.picture.SightPicture` by file name.
        rounds: pictures of rounds, by method of :class:`mirror_ppl.plots.fit.FitPlots`.
    """

    networks: Mapping[str, Any] = field(default_factory=dict)
    paper_networks: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    planning: Mapping[str, Any] = field(default_factory=dict)
    baselines: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    likelihood_power: float = 1.0
    consistency: float = CONSISTENCY
    value_error: float = 0.0
    sight_scale: float | None = None
    measured: int = 4000
    slow: tuple[str, ...] = ("mirror-svi", "sqil-everything", "sqil-pooled")
    people: Any = None
    human_models: Any = field(default_factory=dict)
    pictures: Any = field(default_factory=dict)
    rounds: Any = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_power(self.likelihood_power, "likelihood_power")
        real_number(self.consistency, "consistency", *CONSISTENCIES)
        real_number(self.value_error, "value_error", 0.0, LARGEST_ERROR)
        if self.sight_scale is not None:
            real_number(self.sight_scale, "sight_scale", LEAST_SIGHT_SCALE)

    def part(self, name: str) -> Any:
        """Return one of the attributes, imported if it is a string ``"module:name"``.

        Raises:
            DomainError: the module cannot be imported, or has no such name.
        """
        value = getattr(self, name)
        if not isinstance(value, str):
            return value
        module, _, attribute = value.partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError, ValueError) as error:
            raise DomainError(f'{name}: there is no "{value}": {error}') from error


def require_power(value: Any, name: str) -> float:
    """Return a power of the likelihood as a float.

    Raises:
        InputError: it is not a number from ``LEAST_POWER`` to 1.
    """
    return real_number(value, name, LEAST_POWER, 1.0)


def settings_of(record: Record, kind: str, options: type) -> Mapping[str, Any]:
    """Return the settings ``training`` or ``planning`` of a world.

    Raises:
        DomainError: there is no such setting.
    """
    own = getattr(record, kind)
    known = [each.name for each in fields(options)]
    for each in own:
        if each not in known:
            raise DomainError(f"{kind} has {each}, expected some of {', '.join(known)}")
    return own

"""Recorded rounds of people: observations, messages and actions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.checks import as_tensor, listed, require_keys, whole_number
from mirror_ppl.data import schema
from mirror_ppl.data.provenance import checked_provenance
from mirror_ppl.data.schema import MEASURED, NO_INDEX, TOLD, TRUTH
from mirror_ppl.devices import usable_device
from mirror_ppl.domains import Observation, get_domain, require_known
from mirror_ppl.errors import DemonstrationsError, is_name, shown

OPTIONAL = {
    "reward": "rewards",
    "scenario": "scenarios",
    "action_entropy": "action_entropy",
    "control": "controls",
}
"""Variables that may be absent, and the fields that hold them."""


@dataclass(frozen=True, eq=False, repr=False)
class Demonstrations:
    """Recorded rounds of P people, valid by construction and not to be modified.

    People may have different numbers of rounds (or none), rounds different lengths. Arrays have the
    size of the largest; the rest is padding. Rounds, steps and times count from 0. Arrays (tensors,
    numpy arrays or lists) are copied and converted to a standard form on creation, whatever their
    numeric dtype and their padding.

    Args:
        domain: name of the domain.
        setting: name of the domain's setting that the rounds took place in.
        people: P ids, unique, printable, of at most 100 characters.
        ego: the ego's features ``[P, B, T+1, E]``, in the domain's units; NaN in padding.
        observations: for each modality everything that could be observed, ``[P, B, T+1, K, F]``, in
            the domain's units; NaN in padding. What the person saw of it is not recorded.
        actions: indices of actions ``[P, B, T]``; -1 in padding.
        round_counts: number of rounds of each person ``[P]``.
        lengths: number of actions of each round ``[P, B]``, at least 1; 0 for padding.
        told: for each modality the items communicated just before the action,
            ``[P, B, T, K]``, bool; none unless given.
        rewards: task rewards ``[P, B, T]`` in units of reward; NaN in padding.
        scenarios: indices of scenarios ``[P, B]``; -1 in padding and where unknown.
        truth: values ``[P]`` of implants by name, known of simulated people only; NaN where
            unknown.
        action_entropy: entropy in nats of a simulated person's choice, ``[P, B, T]``, from 0 to the
            logarithm of the number of actions; NaN in padding and where unknown.
        measurements: values ``[P]`` of sites of the human model's prior that were measured, such as
            answers to a questionnaire, by name; NaN where unknown. Fits observe them.
        controls: what was executed where actions are continuous, ``[P, B, T, C]``, within the
            bounds of the domain's controls; NaN in padding. ``actions`` are those nearest to it.
        provenance: where the recordings come from: command, seed, population, version.

    Raises:
        UnknownNameError: the domain or its setting is unknown.
        DemonstrationsError: shapes or values are not valid; the message names person, round and
            variable, what was expected and what was given.
    """

    domain: str
    setting: str
    people: tuple[str, ...]
    ego: Tensor
    observations: Mapping[str, Tensor]
    actions: Tensor
    round_counts: Tensor
    lengths: Tensor
    told: Mapping[str, Tensor] = field(default_factory=dict)
    rewards: Tensor | None = None
    scenarios: Tensor | None = None
    truth: Mapping[str, Tensor] = field(default_factory=dict)
    action_entropy: Tensor | None = None
    measurements: Mapping[str, Tensor] = field(default_factory=dict)
    controls: Tensor | None = None
    provenance: Mapping[str, str | int | float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        domain = get_domain(self.domain)
        require_known(self.setting, "setting", domain.settings, domain.name)
        modalities = {modality.name: modality for modality in domain.modalities}
        require_keys(self.observations, modalities, "observations", DemonstrationsError)
        require_keys(self.told, modalities, "told", DemonstrationsError, all_of_them=False)
        _check_names(self.truth, "truth")
        _check_names(self.measurements, "measurements")
        people = listed(self.people, "people", "ids", DemonstrationsError)
        provenance = checked_provenance(self.provenance)
        variables: dict[str, Any] = self.variables()
        actions = as_tensor(self.actions, "action", DemonstrationsError)
        for name, modality in modalities.items():
            nothing = torch.zeros(*actions.shape, len(modality.items), dtype=torch.bool)
            variables.setdefault(TOLD + name, nothing)
        variables = schema.checked(domain, people, variables)
        fields = {
            "people": tuple(map(str, people)),
            "ego": variables["ego"],
            "observations": {name: variables[name] for name in modalities},
            "actions": variables["action"],
            "round_counts": variables["round_count"],
            "lengths": variables["length"],
            "told": {name: variables[TOLD + name] for name in modalities},
            "truth": {name: variables[TRUTH + name] for name in self.truth},
            "measurements": {name: variables[MEASURED + name] for name in self.measurements},
            "provenance": provenance,
        }
        fields |= {OPTIONAL[name]: variables[name] for name in OPTIONAL.keys() & variables.keys()}
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_variables(
        cls,
        domain: str,
        setting: str,
        people: Sequence[str],
        variables: Mapping[str, Any],
        provenance: Mapping[str, str | int | float] | None = None,
    ) -> Demonstrations:
        """Make demonstrations of arrays named as in files, the inverse of `variables`.

        Without ``round_count`` each person has all rounds, without ``length`` each round all steps,
        and without ``action`` the actions are those nearest to ``control``.
        Variables of other names are ignored.

        Raises:
            UnknownNameError: as for the class.
            DemonstrationsError: as for the class; or a required variable is missing.
        """
        modalities = [modality.name for modality in get_domain(domain).modalities]
        if not isinstance(variables, Mapping):
            raise DemonstrationsError(f"variables must be a dict of arrays, not {shown(variables)}")
        variables = schema.with_actions(get_domain(domain), variables)
        for name in schema.required_variables(get_domain(domain)):
            if name not in variables:
                raise DemonstrationsError(f"the variable {name} is missing")
        actions = as_tensor(variables["action"], "action", DemonstrationsError)
        # Wrong shapes are reported by the check of the class.
        number, rounds, steps = actions.shape if actions.dim() == 3 else (0, 0, 0)
        counts = variables.get("round_count", torch.full((number,), rounds))
        counts = as_tensor(counts, "round_count", DemonstrationsError)
        every = steps * (torch.arange(rounds) < counts.reshape(-1, 1).cpu())
        return cls(
            domain=domain,
            setting=setting,
            people=people,  # pyright: ignore[reportArgumentType] - the class makes a tuple of it
            ego=variables["ego"],
            observations={name: variables[name] for name in modalities},
            actions=actions,
            round_counts=counts,
            lengths=variables.get("length", every),
            told=_without_prefix(TOLD, variables),
            truth=_without_prefix(TRUTH, variables),
            measurements=_without_prefix(MEASURED, variables),
            provenance=provenance or {},
            **{key: variables.get(name) for name, key in OPTIONAL.items()},
        )

    def variables(self) -> dict[str, Tensor]:
        """Arrays by their names in files; absent ones are left out."""
        optional = {name: getattr(self, field) for name, field in OPTIONAL.items()}
        return {
            "round_count": self.round_counts,
            "length": self.lengths,
            "ego": self.ego,
            **self.observations,
            **{TOLD + name: value for name, value in self.told.items()},
            "action": self.actions,
            **{name: value for name, value in optional.items() if value is not None},
            **{TRUTH + name: value for name, value in self.truth.items()},
            **{MEASURED + name: value for name, value in self.measurements.items()},
        }

    @property
    def num_people(self) -> int:
        """Number of people, P."""
        return len(self.people)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(P, B, T): people, and rounds and steps of the arrays, padding included."""
        people, rounds, steps = self.actions.shape
        return people, rounds, steps

    @property
    def mask(self) -> Tensor:
        """True for real steps, False in padding, ``[P, B, T]``."""
        return self.actions != NO_INDEX

    def __repr__(self) -> str:
        people = f"{self.num_people} {'person' if self.num_people == 1 else 'people'}"
        least, most = int(self.round_counts.min()), int(self.round_counts.max())
        rounds = (
            f"{most} round{'s' * (most != 1)}" if least == most else f"{least} to {most} rounds"
        )
        return (
            f"Demonstrations({self.domain}, {self.setting}: "
            f"{people}, {rounds} each, {int(self.lengths.sum())} steps in all)"
        )

    def equals(self, other: Demonstrations) -> bool:
        """True if everything is equal, padding and provenance included."""
        if self.variables().keys() != other.variables().keys():
            return False
        theirs = other.variables()
        return (
            (self.domain, self.setting, self.people) == (other.domain, other.setting, other.people)
            and self.provenance == other.provenance
            and all(_identical(value, theirs[name]) for name, value in self.variables().items())
        )

    def observation(self) -> Observation:
        """Everything that could be observed, in the domain's layout and finite everywhere.

        Returns:
            ``"ego"`` ``[P, B, T+1, E]`` and each modality ``[P, B, T+1, K, F]``. Past a round's end
            its last observation is repeated; padding rounds are 0.
        """
        times = torch.arange(self.ego.shape[2], device=self.ego.device)
        # [P, B, T+1]: the time itself, or the round's last one.
        time = torch.minimum(times, self.lengths[..., None])
        person = torch.arange(self.shape[0], device=time.device)[:, None, None]
        round_ = torch.arange(self.shape[1], device=time.device)[:, None]
        return {
            name: value[person, round_, time].nan_to_num(0.0)
            for name, value in (("ego", self.ego), *self.observations.items())
        }

    def select_people(self, people: Sequence[str] | Sequence[int]) -> Demonstrations:
        """Select people, in this order, with no more padding than they need.

        Args:
            people: ids, or indices from 0.

        Raises:
            UnknownNameError: no person has that id.
            DemonstrationsError: an index is out of range or not a whole number, a person is named
                twice, or the list is empty or not a list.
        """
        chosen = []
        for person in listed(people, "people", "ids or indices", DemonstrationsError):
            if isinstance(person, str):
                chosen.append(self.people.index(require_known(person, "person", self.people)))
            else:
                chosen.append(_in_range("person", person, self.num_people))
        index = torch.tensor(chosen, dtype=torch.long, device=self.actions.device)
        variables = {name: value[index] for name, value in self.variables().items()}
        return self._like(variables, [self.people[number] for number in chosen])

    def part(self, people: range) -> Demonstrations:
        """Select a range of people with all the padding, so that B and T stay the same."""
        if len(people) == self.num_people:
            return self
        return Demonstrations.from_variables(
            self.domain,
            self.setting,
            self.people[people.start : people.stop],
            {name: value[people.start : people.stop] for name, value in self.variables().items()},
            self.provenance,
        )

    def select_rounds(self, rounds: slice | Sequence[int]) -> Demonstrations:
        """Select rounds of each person, with no more padding than they need.

        Args:
            rounds: a slice, applied to each person's own rounds (``slice(-5, None)`` keeps the last
                five of each); or numbers from 0, in the order wanted, of which each person keeps
                those that they have. People who have none of them stay, with no rounds.

        Raises:
            DemonstrationsError: a number is negative, beyond all people's rounds or named twice, or
                is no number.
        """
        counts = self.round_counts.tolist()
        if isinstance(rounds, slice):
            _check_slice(rounds)
            kept = [list(range(count)[rounds]) for count in counts]
        else:
            numbers = listed(rounds, "rounds", "numbers, or a slice", DemonstrationsError)
            numbers = [_in_range("round", number, max(counts)) for number in numbers]
            # A round that is selected twice would count as twice the evidence.
            if repeated := [number for number in numbers if numbers.count(number) > 1]:
                raise DemonstrationsError(f"round {repeated[0]} is selected more than once")
            kept = [[number for number in numbers if number < count] for count in counts]
        most = max(1, *map(len, kept))
        index = torch.tensor([row + [0] * (most - len(row)) for row in kept])
        index = index.to(self.actions.device)
        new_counts = torch.tensor([len(row) for row in kept], device=index.device)
        person = torch.arange(len(kept), device=index.device)[:, None]
        variables = {
            name: value[person, index] if "round" in self._dimensions(name) else value
            for name, value in self.variables().items()
        }
        begun = torch.arange(most, device=index.device) < new_counts[:, None]
        variables |= {"round_count": new_counts, "length": variables["length"] * begun}
        return self._like(variables, self.people)

    def to(self, device: torch.device | str) -> Demonstrations:
        """Copy the recordings to a device.

        Raises:
            UnknownNameError: there is no such device here.
        """
        usable_device(str(device))
        variables = {name: value.to(device) for name, value in self.variables().items()}
        return self.from_variables(
            self.domain, self.setting, self.people, variables, self.provenance
        )

    def _dimensions(self, name: str) -> tuple[str, ...]:
        return schema.variable_dimensions(get_domain(self.domain)).get(name, ("person",))

    def _like(self, variables: Mapping[str, Tensor], people: Sequence[str]) -> Demonstrations:
        """Replace arrays and people, and remove padding that is not needed."""
        most = {
            "round": max(1, int(variables["round_count"].max())) if people else 1,
            "step": max(1, int(variables["length"].max())) if people else 1,
        }
        most["time"] = most["step"] + 1
        fitted = {
            name: _fit(value, self._dimensions(name), most) for name, value in variables.items()
        }
        return self.from_variables(self.domain, self.setting, people, fitted, self.provenance)


def concatenate(parts: Iterable[Demonstrations]) -> Demonstrations:
    """Join the people of all parts, in order, on the first part's device.

    Scenarios, truths, measurements and entropies that a part lacks become unknown. Rewards and
    controls are kept if every part has them, provenance where all parts agree.

    Raises:
        DemonstrationsError: there are no parts, or some are not demonstrations; the parts are of
            different domains or settings, or an id occurs twice.
    """
    parts = listed(parts, "parts", "demonstrations", DemonstrationsError)
    for part in parts:
        if not isinstance(part, Demonstrations):
            raise DemonstrationsError(f"parts must be demonstrations, not {shown(part)}")
    if not parts:
        raise DemonstrationsError("there are no demonstrations to put together")
    first = parts[0]
    for part in parts:
        if (part.domain, part.setting) != (first.domain, first.setting):
            raise DemonstrationsError(
                f"demonstrations of {part.domain}, {part.setting} cannot be put together with "
                f"those of {first.domain}, {first.setting}"
            )
    rounds, steps = (max(part.shape[axis] for part in parts) for axis in (1, 2))
    sizes = {"round": rounds, "step": steps, "time": steps + 1}
    arrays = [part.variables() for part in parts]
    names = dict.fromkeys(name for part in arrays for name in part)
    for name, key in (("reward", "rewards"), ("control", "controls")):
        if any(getattr(part, key) is None for part in parts):
            names.pop(name, None)
    dimensions = schema.variable_dimensions(get_domain(first.domain))
    variables = {}
    for name in names:
        dims = dimensions.get(name, ("person",))
        unknown = NO_INDEX if name == "scenario" else torch.nan
        pieces = []
        for part, own in zip(parts, arrays, strict=True):
            if name in own:
                piece = own[name]
            else:
                piece = part.ego.new_full(part.actions.shape[: len(dims)], unknown)
            pieces.append(_fit(piece, dims, sizes).to(first.actions.device))
        variables[name] = torch.cat(pieces)
    provenance = {
        key: value
        for key, value in first.provenance.items()
        if all(part.provenance.get(key) == value for part in parts)
    }
    people = [person for part in parts for person in part.people]
    return Demonstrations.from_variables(first.domain, first.setting, people, variables, provenance)


def _fit(value: Tensor, dimensions: Sequence[str], sizes: Mapping[str, int]) -> Tensor:
    """Cut or extend some dimensions to these sizes; added entries count as padding."""
    shape = [sizes.get(name, size) for name, size in zip(dimensions, value.shape, strict=True)]
    fitted = value.new_zeros(shape)
    common = tuple(slice(min(old, new)) for old, new in zip(value.shape, shape, strict=True))
    fitted[common] = value[common]
    return fitted


def _without_prefix(prefix: str, variables: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {
        name.removeprefix(prefix): value
        for name, value in variables.items()
        if name.startswith(prefix)
    }


def _identical(one: Tensor, other: Tensor) -> bool:
    if one.shape != other.shape or one.dtype != other.dtype:
        return False
    return bool(((one == other) | (one.isnan() & other.isnan())).all())


def _in_range(kind: str, value: Any, end: int) -> int:
    number = whole_number(value, f"the number of a {kind}", error=DemonstrationsError)
    if not 0 <= number < end:
        raise DemonstrationsError(
            f"there is no {kind} {number}, expected one of {end}, counted from 0"
        )
    return number


def _check_slice(rounds: slice) -> None:
    try:
        range(0)[rounds]
    except (TypeError, ValueError) as error:
        raise DemonstrationsError(
            f"rounds must be a slice of whole numbers, not {shown(rounds)} ({error})"
        ) from error


def _check_names(values: Any, what: str) -> None:
    if not isinstance(values, Mapping):
        raise DemonstrationsError(f"{what} must be a dict of values by name, not {shown(values)}")
    for name in values:
        if not is_name(name) or "/" in name:
            raise DemonstrationsError(f"{what} has {shown(name)}, expected {schema.A_NAME}, no /")

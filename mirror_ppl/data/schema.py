"""Format of a recording: its variables, their dimensions and their validity.

A recording is a set of arrays with the same names in memory and in files (see
``docs/demonstrations.md``). Every array begins with the dimension ``person``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.checks import as_tensor
from mirror_ppl.domains import Domain
from mirror_ppl.domains.controls import bounds_in_words, nearest_action, within_bounds
from mirror_ppl.errors import MOST_CHARACTERS, DemonstrationsError, is_name, shown

TOLD = "told_"
"""Prefix of the items communicated through a modality."""
TRUTH = "truth_"
"""Prefix of the true value of an implant."""
MEASURED = "measured_"
"""Prefix of a measurement of a person, such as an answer to a questionnaire."""
OF_PERSON = (TRUTH, MEASURED)
"""Prefixes of variables that have one number a person."""
CONTROL = "control"
"""What was executed where actions are continuous; ``action`` is the one nearest to it."""
NO_INDEX = -1
"""Stands for the actions and scenarios of padding, and for scenarios that are unknown."""
ROUNDING = 1e-3
"""Amount by which an entropy may be out of its range."""
A_NAME = f"printable text of at most {MOST_CHARACTERS} characters"
"""Requirement for ids and names of truths."""


def variable_dimensions(domain: Domain) -> dict[str, tuple[str, ...]]:
    """Names of the dimensions of each variable; those of `OF_PERSON` are ``person`` alone."""
    rounds = ("person", "round")
    steps, times = (*rounds, "step"), (*rounds, "time")
    dimensions = {
        "round_count": ("person",),
        "length": rounds,
        "ego": (*times, "ego_feature"),
        "action": steps,
        "reward": steps,
        "scenario": rounds,
        "action_entropy": steps,
    }
    if domain.controls:
        dimensions[CONTROL] = (*steps, "control_name")
    for modality in domain.modalities:
        item, feature = f"{modality.name}_item", f"{modality.name}_feature"
        dimensions[modality.name] = (*times, item, feature)
        dimensions[TOLD + modality.name] = (*steps, item)
    return dimensions


def required_variables(domain: Domain) -> tuple[str, ...]:
    """Names of the variables that every file has; ``control`` can replace ``action``."""
    return ("ego", *(modality.name for modality in domain.modalities), "action")


def with_actions(domain: Domain, variables: Mapping[str, Any]) -> Mapping[str, Any]:
    """Add ``action``, if it is missing, from ``control``; -1 in padding."""
    if "action" in variables or not domain.controls or CONTROL not in variables:
        return variables
    control = as_tensor(variables[CONTROL], CONTROL, DemonstrationsError)
    if control.dim() != 4 or control.shape[-1] != len(domain.controls):  # noqa: PLR2004
        raise DemonstrationsError(
            f"{CONTROL} has shape {tuple(control.shape)}, expected people, rounds, steps and "
            f"{len(domain.controls)} controls"
        )
    known = ~control.double().isnan().any(-1)
    nearest = nearest_action(domain.controls, control.double().nan_to_num(0.0))
    return {**variables, "action": nearest.masked_fill(~known, NO_INDEX)}


def dimension_labels(domain: Domain) -> dict[str, tuple[str, ...]]:
    """Names along each dimension whose entries the domain names."""
    labels = {"ego_feature": domain.ego_features}
    if domain.controls:
        labels["control_name"] = tuple(one.name for one in domain.controls)
    for modality in domain.modalities:
        labels[f"{modality.name}_item"] = modality.items
        labels[f"{modality.name}_feature"] = modality.features
    return labels


def checked(
    domain: Domain, people: Sequence[str], variables: Mapping[str, Any]
) -> dict[str, Tensor]:
    """Check a recording and convert it to its standard form.

    Args:
        domain: of the recording.
        people: ids of the P people.
        variables: arrays by name, tensors or what `mirror_ppl.checks.as_tensor` takes, of any
            numeric dtype: ``round_count``, ``length``, what `required_variables` lists, and any of
            the others.

    Returns:
        Copies on the device of ``action``. Numbers are in torch's default dtype and NaN in padding;
        indices are int64 and -1 in padding; communicated items are bool and False in padding.

    Raises:
        DemonstrationsError: one line with variable, person, round and step where they apply, what
            was expected and what was given.
    """
    _check_people(people)
    if CONTROL in variables and not domain.controls:
        raise DemonstrationsError(f"{CONTROL} is given, but actions of {domain.name} are numbered")
    dimensions = variable_dimensions(domain)
    dimensions |= {name: ("person",) for name in variables if name.startswith(OF_PERSON)}
    places = _Places(tuple(people), dimensions, dimension_labels(domain))
    action = as_tensor(variables["action"], "action", DemonstrationsError)
    sizes = places.sizes(action)
    device = action.device
    given: dict[str, Tensor] = {}
    for name, value in variables.items():
        given[name] = as_tensor(value, name, DemonstrationsError).to(device)
        places.check_shape(name, given[name], sizes)

    counts = places.whole("round_count", given, None, 0, sizes["round"])
    lengths = places.whole("length", given, None, 0, sizes["step"])
    begun = torch.arange(sizes["round"], device=device) < counts[:, None]
    places.refuse(
        "length", begun & (lengths == 0), lengths, "at least 1 (padding begins at round_count)"
    )
    places.refuse("length", ~begun & (lengths > 0), lengths, "0 (padding begins at round_count)")
    times = torch.arange(sizes["time"], device=device)
    real = {
        "round": begun,
        "step": times[:-1] < lengths[..., None],
        "time": begun[..., None] & (times <= lengths[..., None]),
    }

    result = {"round_count": counts, "length": lengths}
    dtype = torch.get_default_dtype()
    for name, value in given.items():
        if name in result:
            continue
        if name.startswith(OF_PERSON):
            result[name] = value.to(dtype, copy=True)
            expected = "a finite number, or nan if unknown"
            places.refuse(name, result[name].isinf(), result[name], expected)
            continue
        inside = real[next(key for key in reversed(dimensions[name]) if key in real)]
        if name == "action":
            highest = len(domain.actions) - 1
            names = ", ".join(domain.actions)
            actions = places.whole(name, given, inside, 0, highest, f" ({names})")
            result[name] = actions.masked_fill(~inside, NO_INDEX)
        elif name == "scenario":
            highest = len(domain.scenarios) - 1
            scenarios = places.whole(name, given, inside, NO_INDEX, highest, " (-1 if unknown)")
            result[name] = scenarios.masked_fill(~inside, NO_INDEX)
        elif name.startswith(TOLD):
            result[name] = places.whole(name, given, inside, 0, 1).bool()
        elif name == CONTROL:
            result[name] = places.controls(name, value.to(dtype), inside, domain)
        elif name == "action_entropy":
            result[name] = places.entropies(name, value.to(dtype), inside, len(domain.actions))
        else:
            result[name] = places.numbers(name, value.to(dtype), inside)
    if CONTROL in result:
        nearest = nearest_action(domain.controls, result[CONTROL].nan_to_num(0.0))
        differs = real["step"] & (nearest != result["action"])
        expected = "the action nearest to the control; leave action out, and it is computed"
        places.refuse("action", differs, result["action"], expected)
    return result


def _check_people(people: Sequence[str]) -> None:
    if not people:
        raise DemonstrationsError("there are no people, expected at least one person")
    seen = set()
    for person in people:
        if not is_name(person):
            raise DemonstrationsError(f"person's id is {shown(person)}, expected {A_NAME}")
        if person in seen:
            raise DemonstrationsError(f"two people have the id {person!r}, expected unique ids")
        seen.add(person)


@dataclass(frozen=True)
class _Places:
    """Checks values, and says where the first wrong one is."""

    people: tuple[str, ...]
    dimensions: Mapping[str, tuple[str, ...]]
    labels: Mapping[str, tuple[str, ...]]

    def sizes(self, action: Tensor) -> dict[str, int]:
        """Sizes that all variables must agree on: the actions' and the domain's."""
        if action.dim() != 3 or 0 in action.shape:
            raise DemonstrationsError(
                f"action has shape {tuple(action.shape)}, expected people, rounds and steps, "
                "at least one of each"
            )
        _, rounds, steps = action.shape
        sizes = {"person": len(self.people), "round": rounds, "step": steps, "time": steps + 1}
        return sizes | {name: len(labels) for name, labels in self.labels.items()}

    def check_shape(self, name: str, value: Tensor, sizes: Mapping[str, int]) -> None:
        expected = {key: sizes[key] for key in self.dimensions[name]}
        if tuple(value.shape) != tuple(expected.values()):
            wanted = ", ".join(f"{key} {size}" for key, size in expected.items())
            message = (
                f"{name} has shape {tuple(value.shape)}, "
                f"expected {tuple(expected.values())} ({wanted})"
            )
            pairs = zip(expected.items(), value.shape, strict=False)
            wrong = {key for (key, size), own in pairs if size != own}
            if value.dim() == len(expected) and wrong <= {"time", "step"}:
                message += f", as there are {sizes['step']} actions a round"
            raise DemonstrationsError(message)

    def refuse(
        self, name: str, bad: Tensor, value: Tensor, expected: str, inside: Tensor | None = None
    ) -> None:
        """Raise for the first entry of ``value`` that is bad.

        With ``inside``, the mask of what is read, the message says how to mark padding if the rest
        of the round looks like padding: -1 or NaN.
        """
        if not bad.any():
            return
        index = tuple(bad.nonzero()[0].tolist())
        where, of = [f"person {self.people[index[0]]!r}"], []
        for dimension, place in zip(self.dimensions[name][1:], index[1:], strict=True):
            if dimension in self.labels:
                of.append(self.labels[dimension][place])
            else:
                where.append(f"{dimension} {place}")
        what = f"{name} of {', '.join(of)}" if of else name
        hint = "" if inside is None else self._hint(name, index, value, inside)
        raise DemonstrationsError(
            f"{', '.join(where)}: {what} is {value[index].item():g}, expected {expected}{hint}"
        )

    def _hint(self, name: str, index: tuple[int, ...], value: Tensor, inside: Tensor) -> str:
        """Name the variable that marks padding, if the round's rest looks like padding."""
        if name == "reward" or self.dimensions[name][2:3] not in (("step",), ("time",)):
            return ""
        person, number, step = index[:3]
        rest, read = value[person, number, step:], inside[person, number, step:]
        if not (rest.isnan() | (rest == NO_INDEX))[read].all():
            return ""
        if step == 0:
            return "; if the round is padding, round_count has to be the person's number of rounds"
        return "; if this is padding, length has to be the round's number of actions"

    def whole(
        self,
        name: str,
        given: Mapping[str, Tensor],
        inside: Tensor | None,
        lowest: int,
        highest: int,
        meaning: str = "",
    ) -> Tensor:
        """Whole numbers as int64; outside of ``inside`` anything is allowed and becomes 0."""
        value = given[name].double()
        good = (value >= lowest) & (value <= highest) & (value == value.round())
        inside = torch.ones_like(good) if inside is None else _over_items(inside, good)
        expected = f"a whole number from {lowest} to {highest}{meaning}"
        self.refuse(name, inside & ~good, value, expected, inside)
        return value.masked_fill(~inside, 0).long()

    def numbers(self, name: str, value: Tensor, inside: Tensor) -> Tensor:
        """Finite numbers; outside of ``inside`` anything is allowed and becomes NaN."""
        inside = _over_items(inside, value)
        self.refuse(name, inside & ~value.isfinite(), value, "a finite number", inside)
        return value.masked_fill(~inside, torch.nan)

    def controls(self, name: str, value: Tensor, inside: Tensor, domain: Domain) -> Tensor:
        """Finite numbers within the bounds of each control; NaN in padding."""
        result = self.numbers(name, value, inside)
        outside = ~within_bounds(domain.controls, result) & ~result.isnan()
        self.refuse(
            name, outside, result, f"within its bounds ({bounds_in_words(domain.controls)})"
        )
        return result

    def entropies(self, name: str, value: Tensor, inside: Tensor, actions: int) -> Tensor:
        """Entropies in nats of a choice among ``actions`` actions, or NaN; NaN in padding."""
        most = math.log(actions)
        possible = (value >= -ROUNDING) & (value <= most + ROUNDING)
        expected = f"from 0 to {most:.4g} (log of {actions} actions), or nan if unknown"
        self.refuse(name, inside & ~possible & ~value.isnan(), value, expected)
        return value.masked_fill(~inside, torch.nan)


def _over_items(inside: Tensor, like: Tensor) -> Tensor:
    """Expand the mask over the dimensions that ``like`` has beyond the mask's."""
    return inside.reshape(inside.shape + (1,) * (like.dim() - inside.dim())).expand_as(like)

"""Measurements of people besides their rounds, such as answers, as observed sites of the prior."""

from __future__ import annotations

import copy
from itertools import groupby

import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.errors import InputError
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, sample_sites
from mirror_ppl.randomness import forked


def require_measurable(human: HumanModel, rounds: Demonstrations) -> None:
    """Check that measurements are values of scalar sites of the prior.

    Raises:
        InputError: they are not.
    """
    with forked():
        sites = sample_sites(human, 1)
    for name, values in rounds.measurements.items():
        if name not in sites or sites[name]["fn"].event_dim:
            numbers = [site for site, node in sites.items() if not node["fn"].event_dim]
            raise InputError(
                f'"{name}" was measured, but is no site of {type(human).__name__}.prior that is '
                f"one number a person; those are {', '.join(numbers)}"
            )
        support = sites[name]["fn"].support
        for person, value in zip(rounds.people, values.flatten(), strict=True):
            if not (value.isnan() or bool(support.check(value).all())):
                raise InputError(
                    f'"{name}" of {person} is {float(value):g}, which its site, with the support '
                    f"{support}, cannot be"
                )


def with_measurements(human: HumanModel, rounds: Demonstrations) -> HumanModel:
    """Return the human model of these P people, conditioned on their measured sites.

    The same sites have to be measured for all of them, see :func:`alike_measured`.
    """
    known = _known(rounds)
    if not known:
        return human
    observed = copy.copy(human)
    conditioned = poutine.condition(observed.prior, data=known)
    object.__setattr__(observed, "prior", conditioned)
    return observed


def measured_draws(rounds: Demonstrations, number: int) -> Draws:
    """Return measured sites as draws ``[S, P, 1]``, so that there are draws of every site."""
    return {name: value.expand(number, *value.shape) for name, value in _known(rounds).items()}


def alike_measured(rounds: Demonstrations) -> list[range]:
    """Return ranges of consecutive people with the same sites measured."""
    people = range(rounds.num_people)
    if not rounds.measurements:
        return [people]
    unknown = torch.stack([value.isnan() for value in rounds.measurements.values()], -1).tolist()
    found = []
    for _, group in groupby(people, key=lambda person: unknown[person]):
        some = list(group)
        found.append(range(some[0], some[-1] + 1))
    return found


def _known(rounds: Demonstrations) -> dict[str, Tensor]:
    """Return values ``[P, 1]`` of the sites that were measured."""
    return {
        name: value[:, None]
        for name, value in rounds.measurements.items()
        if not bool(value.isnan().any())
    }

"""Predictions and identifiability of people, computed from their posterior draws.

Each person is described separately, so that people can be distributed over processes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.inference.population.pooling import Population
from mirror_ppl.inference.results.identifiability import Identifiability, identify
from mirror_ppl.inference.results.predictions import Predictions, predict_person
from mirror_ppl.inference.workers import PersonAt, Workers
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, draw_prior_of_each
from mirror_ppl.timing import add_seconds, clocked, stage

PRIOR_DRAWS = 100


@dataclass(frozen=True)
class Described:
    """Description of P people.

    Attributes:
        prior: prior draws for each person ``[S', P, 1, ...]``.
        predictions: predictions of their actions.
        identifiability: posterior entropies and expected information gains, where defined.
        seconds: processor time by stage.
    """

    prior: Draws
    predictions: Predictions
    identifiability: Identifiability | None
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class Description:
    """Settings of :func:`describe`.

    Attributes:
        human: the model of people.
        seed: seed of all random draws.
        explore: rounds that are simulated in each scenario.
        population: posterior of the population, if people were pooled.
        every_draw: True to keep held-out predictions under every draw, not only their mean, and all
            sites of the prior, not only those with one number per person.
    """

    human: HumanModel
    seed: int
    explore: int = 0
    population: Population | None = None
    every_draw: bool = False


@dataclass(frozen=True)
class OnePerson:
    """One person, with their posterior draws.

    Attributes:
        train: training rounds.
        test: held-out rounds, if there are any.
        draws: posterior draws ``[S, 1, 1, ...]``.
        combinations: see :func:`describe`.
    """

    train: Demonstrations
    test: Demonstrations | None
    draws: Mapping[str, Tensor]
    combinations: Sequence[Tensor]


def describe(
    how: Description,
    train: Demonstrations,
    test: Demonstrations | None,
    draws: Mapping[str, Tensor],
    combinations: Sequence[Tensor] = (),
    workers: Workers = Workers(),  # noqa: B008 - frozen
    identity: str = "",
) -> Described:
    """Describe P people.

    Args:
        how: settings.
        train: training rounds.
        test: held-out rounds, if there are any.
        draws: posterior draws ``[S, P, 1, ...]``.
        combinations: probable combinations of each person's discrete implants, if known; see
            :class:`~mirror_ppl.inference.engine.Inferred`.
        workers: processes to use.
        identity: identifies everything that the result depends on.
    """

    def given(person: PersonAt) -> OnePerson:
        own = person.range
        return OnePerson(
            train.part(own),
            None if test is None else test.part(own),
            {name: value[:, [person.number]] for name, value in draws.items()},
            combinations[own.start : own.stop],
        )

    parts = workers.run("describe", train.num_people, partial(_describe, how), given, identity)
    seconds: dict[str, float] = {}
    for part in parts:
        add_seconds(seconds, part["seconds"])
    unidentified = [part["identifiability"] for part in parts]
    return Described(
        {name: torch.cat([part["prior"][name] for part in parts], 1) for name in parts[0]["prior"]},
        Predictions.joined([Predictions(**part["predictions"]) for part in parts]),
        None if None in unidentified else Identifiability.joined(unidentified),
        seconds,
    )


def _describe(how: Description, one: OnePerson) -> dict[str, Any]:
    human = how.human
    with clocked() as seconds:
        with stage("predict"):
            prior = draw_prior_of_each(human, one.train.people, PRIOR_DRAWS, how.seed)
            rounds = one.train, one.test
            found = predict_person(human, rounds, (one.draws, prior), how.seed)
        with stage("identify"):
            unidentified = identify(
                human,
                one.train,
                one.draws,
                how.seed,
                how.population,
                one.combinations,
                rounds=how.explore,
            )
    if not how.every_draw:
        prior = {name: value for name, value in prior.items() if value.dim() == 3}  # noqa: PLR2004
        if found.held_out is not None:
            found = replace(found, held_out=found.held_out.mean(0, keepdim=True))
    return {
        "prior": {name: value.cpu() for name, value in prior.items()},
        "predictions": vars(found),
        "identifiability": None if unidentified is None else vars(unidentified),
        "seconds": seconds,
    }

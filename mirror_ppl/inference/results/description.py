"""What follows from people's draws: predictions, and what their rounds do not identify.

Each person by themselves, so that parts of the people can be described by several processes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.inference.population.pooling import Population
from mirror_ppl.inference.results.identifiability import Identifiability, identify
from mirror_ppl.inference.results.predictions import Predictions, predict_people
from mirror_ppl.inference.workers import People, Workers
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, draw_prior_of_each
from mirror_ppl.timing import add_seconds, clocked, stage

PRIOR_DRAWS = 100


@dataclass(frozen=True)
class Described:
    """What follows from the draws of P people.

    Attributes:
        prior: draws of the prior of each ``[S', P, 1, ...]``.
        predictions: of their actions.
        identifiability: what their rounds do not identify, where that is known.
        seconds: of processors that it took, by stage.
    """

    prior: Draws
    predictions: Predictions
    identifiability: Identifiability | None
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class Description:
    """How people are described.

    Attributes:
        human: the model of people.
        seed: of everything random.
        explore: rounds that the model plays in each scenario.
        population: that the people are from, if they were pooled.
        every_draw: keep held-out predictions under every draw, not their mean alone, and all sites
            of the prior, not only those that are one number a person.
    """

    human: HumanModel
    seed: int
    explore: int = 0
    population: Population | None = None
    every_draw: bool = False


@dataclass(frozen=True)
class Part:
    """Some people, with draws ``[S, P, 1, ...]`` of what they are like.

    Attributes:
        first: number of the first of them among all.
        train: the rounds that were learned from.
        test: the held-out rounds, if there are any.
        draws: of the posterior.
    """

    first: int
    train: Demonstrations
    test: Demonstrations | None
    draws: Mapping[str, Tensor]


def describe(
    how: Description,
    train: Demonstrations,
    test: Demonstrations | None,
    draws: Mapping[str, Tensor],
    workers: Workers = Workers(),  # noqa: B008 - frozen
    identity: str = "",
) -> Described:
    """Describe P people.

    Args:
        how: to describe them.
        train: the rounds that were learned from.
        test: the held-out rounds, if there are any.
        draws: of the posterior ``[S, P, 1, ...]``.
        workers: who does it.
        identity: of everything that the result depends on.
    """

    def given(people: People) -> Part:
        some = slice(people.first, people.last)
        return Part(
            people.first,
            train.part(people.range),
            None if test is None else test.part(people.range),
            {name: value[:, some].clone() for name, value in draws.items()},
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


def _describe(how: Description, part: Part) -> dict[str, Any]:
    human, people = how.human, range(part.first, part.first + part.train.num_people)
    with clocked() as seconds:
        with stage("predict"):
            prior = draw_prior_of_each(human, people, PRIOR_DRAWS, how.seed)
            rounds = part.train, part.test
            found = predict_people(human, rounds, (part.draws, prior), how.seed, first=part.first)
        with stage("identify"):
            unidentified = identify(
                human,
                part.train,
                part.draws,
                how.seed,
                how.population,
                rounds=how.explore,
                first=part.first,
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

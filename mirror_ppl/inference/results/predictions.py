"""Predictions and model checks of all people, in groups of a few.

The views of one person's rounds under a hundred draws take up to 13 MB, and log-probabilities of
actions under all draws another one. To bound memory, people are processed in groups, and only the
results of each group are kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.inference.results.criticism import criticize
from mirror_ppl.inference.results.posterior_predictive import (
    chosen_log_probability,
    groups,
    of_people,
    predict_rounds,
)
from mirror_ppl.inference.results.summary import score
from mirror_ppl.models.human import HumanModel
from mirror_ppl.progress import Report, silent
from mirror_ppl.randomness import person_seed

PREDICTIVE_STREAM, CRITICISM_STREAM = 2**31, 2**32
"""Offsets of seeds, so that predictive draws share none with inference and simulated rounds."""


@dataclass(frozen=True)
class Predictions:
    """Predictions of P people's actions, on the CPU.

    Attributes:
        posterior: actions in the training rounds, one for each posterior draw, ``[S, P, B, T]``,
            int8.
        prior: actions there, one for each prior draw, ``[S', P, B, T]``, int8.
        log_likelihood: log-likelihood of training rounds under each posterior draw, ``[S, P, B]``.
        held_out: probabilities of actions in the held-out rounds under each posterior draw,
            ``[S, P, B', T', A]``; ``None`` without such rounds.
        scores: scores of each person's held-out rounds, see :func:`score`; ``None`` without these.
        checks: model criticism of each person, see :func:`criticize`.
    """

    posterior: Tensor
    prior: Tensor
    log_likelihood: Tensor
    held_out: Tensor | None = None
    scores: list[dict[str, Any] | None] | None = None
    checks: Sequence[dict[str, Any]] = ()

    @classmethod
    def joined(cls, parts: Sequence[Predictions]) -> Predictions:
        """The predictions of the people of all parts, in order."""

        def together(tensors: Sequence[Tensor]) -> Tensor:
            return tensors[0] if len(tensors) == 1 else torch.cat(list(tensors), 1)

        held_out = [part.held_out for part in parts if part.held_out is not None]
        scores = [one for part in parts if part.scores is not None for one in part.scores]
        return cls(
            together([part.posterior for part in parts]),
            together([part.prior for part in parts]),
            together([part.log_likelihood for part in parts]),
            together(held_out) if held_out else None,
            scores if held_out else None,
            [one for part in parts for one in part.checks],
        )


@torch.no_grad()
def predict_people(
    human: HumanModel,
    rounds: tuple[Demonstrations, Demonstrations | None],
    draws: tuple[Mapping[str, Tensor], Mapping[str, Tensor]],
    seed: int,
    report: Report = silent,
) -> Predictions:
    """Predict the actions of P people, each given the earlier ones of its round.

    Each person has their own generator, so that predictive draws do not depend on which other
    people were recorded, nor on their order.

    Args:
        human: the model of people.
        rounds: training rounds, and held-out rounds, if there are any.
        draws: implants from the posterior ``[S, P, 1, ...]`` and the prior ``[S', P, 1, ...]``.
        seed: seed of predictive draws.
        report: called with the number of people done.
    """
    (train, test), parts = rounds, []
    people = train.num_people
    seeds = [person_seed(seed, person) for person in train.people]
    for some in groups(people):
        report("predict", some.start, people, "people")
        posterior, prior = (of_people(own, some) for own in draws)
        own = train.part(some)
        generators = [
            torch.Generator().manual_seed(PREDICTIVE_STREAM + own_seed)
            for own_seed in seeds[some.start : some.stop]
        ]
        learned, expected = _predicted(human, own, (posterior, prior))
        part = Predictions(
            _drawn(learned, generators),
            _drawn(expected, generators),
            chosen_log_probability(learned, own.to("cpu")).sum(-1),
        )
        found = None
        if test is not None:
            own = test.part(some)
            found = predict_rounds(human, own, posterior).cpu()
            part = replace(part, held_out=found.exp(), scores=score(found, own.to("cpu")))
        checks = [
            criticize(
                human,
                (train.part(one), None if test is None else test.part(one)),
                (learned[:, place : place + 1], None if found is None else found[:, [place]]),
                {name: value[:, [place]] for name, value in posterior.items()},
                CRITICISM_STREAM + seeds[person],
            )
            for place, (person, one) in enumerate((one, range(one, one + 1)) for one in some)
        ]
        del learned, expected, found
        parts.append(replace(part, checks=checks))
    report("predict", people, people, "people")
    return Predictions.joined(parts)


def _predicted(
    human: HumanModel, rounds: Demonstrations, draws: Sequence[Mapping[str, Tensor]]
) -> list[Tensor]:
    """Predict the same rounds under several sets of draws; see `predict_rounds`.

    Their views are listed once, except where attention is proposed from the draws.
    """
    if human.has_round_latents and not human.chained:
        return [predict_rounds(human, rounds, own).cpu() for own in draws]
    together = {name: torch.cat([own[name] for own in draws]) for name in draws[0]}
    numbers = [len(next(iter(own.values()), ())) for own in draws]
    return list(predict_rounds(human, rounds, together).cpu().split(numbers))


def _drawn(log_probabilities: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
    """Sample actions ``[S, P, B, T]``, int8, from log-probabilities ``[S, P, B, T, A]``."""
    actions = []
    for person, generator in enumerate(generators):
        own = log_probabilities[:, person].exp()
        drawn = torch.multinomial(own.flatten(0, -2), 1, generator=generator)
        actions.append(drawn.view(own.shape[:-1]).to(torch.int8))
    return torch.stack(actions, 1)

"""Predictions and model checks of people, one by one.

Views of a person's rounds, and log-probabilities of actions under all draws, take much memory; only
what results need is kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.inference.results.criticism import criticize
from mirror_ppl.inference.results.posterior_predictive import (
    chosen_log_probability,
    predict_rounds,
)
from mirror_ppl.inference.results.summary import score
from mirror_ppl.inference.second_look import looks_twice
from mirror_ppl.models.human import HumanModel
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
def predict_person(
    human: HumanModel,
    rounds: tuple[Demonstrations, Demonstrations | None],
    draws: tuple[Mapping[str, Tensor], Mapping[str, Tensor]],
    seed: int,
) -> Predictions:
    """Predict the actions of one person, each given the earlier ones of its round.

    Args:
        human: the model of people.
        rounds: training rounds, and held-out rounds, if there are any.
        draws: implants from the posterior ``[S, 1, 1, ...]`` and the prior ``[S', 1, 1, ...]``.
        seed: seed of predictive draws; each person has a stream of their own.
    """
    train, test = rounds
    posterior, _ = draws
    own = person_seed(seed, train.people[0])
    generator = torch.Generator().manual_seed(PREDICTIVE_STREAM + own)
    learned, expected = _predicted(human, train, draws)
    found = None if test is None else predict_rounds(human, test, posterior).cpu()
    return Predictions(
        _drawn(learned, generator),
        _drawn(expected, generator),
        chosen_log_probability(learned, train.to("cpu")).sum(-1),
        None if found is None else found.exp(),
        None if found is None or test is None else score(found, test.to("cpu")),
        [criticize(human, rounds, (learned, found), posterior, CRITICISM_STREAM + own)],
    )


def _predicted(
    human: HumanModel, rounds: Demonstrations, draws: Sequence[Mapping[str, Tensor]]
) -> list[Tensor]:
    """Predict the same rounds under several sets of draws; see `predict_rounds`.

    Their views are listed once, except where attention is proposed from the draws.
    """
    if looks_twice(human):
        return [predict_rounds(human, rounds, own).cpu() for own in draws]
    together = {name: torch.cat([own[name] for own in draws]) for name in draws[0]}
    numbers = [len(next(iter(own.values()))) for own in draws]
    return list(predict_rounds(human, rounds, together).cpu().split(numbers))


def _drawn(log_probabilities: Tensor, generator: torch.Generator) -> Tensor:
    """Sample a person's actions ``[S, 1, B, T]``, int8, from ``[S, 1, B, T, A]``."""
    own = log_probabilities.exp()
    drawn = torch.multinomial(own.flatten(0, -2), 1, generator=generator)
    return drawn.view(own.shape[:-1]).to(torch.int8)

"""Predictions of everybody's actions, a few people at a time.

The views of one person's rounds under a hundred draws take up to 13 MB, and log-probabilities of
actions under all draws another one. Both are needed for a moment only: predictions go through the
people in groups, and of each group nothing is kept but its results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.results.summary import score
from mirror_ppl.likelihood.combinations import perceived_sites
from mirror_ppl.likelihood.compiled import Sequential
from mirror_ppl.likelihood.predictive import predict_actions
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.likelihood.view_table import combination_number
from mirror_ppl.models.human import HumanModel, has_own_program
from mirror_ppl.models.prior import checked_draws
from mirror_ppl.models.recorded import check_rounds
from mirror_ppl.progress import Report, silent

PEOPLE_AT_ONCE = 16
"""People whose views are in memory together. With a multiple of 16, predictions equal those of all
people at once bit for bit, where rounds have an even number of steps in all: processors take the
numbers of an array in blocks of 16 or 32, and may round the rest at its end differently in the last
digit."""
PREDICTED_VALUES = 128
"""Values of attention that predictions average over, where it differs from round to round."""
PREDICTIVE_STREAM = 2**31
"""Added to seeds of predictive draws, which inference and played rounds must not share."""


@dataclass(frozen=True)
class Predictions:
    """Predictions of P people's actions, on the CPU.

    Attributes:
        posterior: actions in the training rounds, one for each posterior draw, ``[S, P, B, T]``,
            int8.
        prior: actions there, one for each prior draw, ``[S', P, B, T]``, int8.
        log_likelihood: of the training rounds under each posterior draw, ``[S, P, B]``.
        held_out: probabilities of actions in the held-out rounds under each posterior draw,
            ``[S, P, B', T', A]``; ``None`` without such rounds.
        scores: of each person's held-out rounds, see :func:`score`; ``None`` without such rounds.
    """

    posterior: Tensor
    prior: Tensor
    log_likelihood: Tensor
    held_out: Tensor | None = None
    scores: list[dict[str, Any] | None] | None = None

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
        )


@torch.no_grad()
def predict_people(
    human: HumanModel,
    rounds: tuple[Demonstrations, Demonstrations | None],
    draws: tuple[Mapping[str, Tensor], Mapping[str, Tensor]],
    seed: int,
    report: Report = silent,
    first: int = 0,
) -> Predictions:
    """Predict what P people do, each action given what was done before it.

    The predictive draws of each person have a generator of their own, so that they do not depend on
    who else was recorded.

    Args:
        human: the model of people.
        rounds: those that were learned from, and the held-out ones, if there are any.
        draws: of implants, from the posterior ``[S, P, 1, ...]`` and the prior ``[S', P, 1, ...]``.
        seed: of predictive draws.
        report: told of people done.
        first: number of the first of these people among all.
    """
    (train, test), parts = rounds, []
    people = train.num_people
    for some in _groups(people):
        report("predict", some.start, people, "people")
        posterior, prior = (_of_people(own, some) for own in draws)
        own = train.part(some)
        generators = [
            torch.Generator().manual_seed(PREDICTIVE_STREAM + seed * 1_000_003 + first + person)
            for person in some
        ]
        learned = predict_rounds(human, own, posterior).cpu()
        part = Predictions(
            _drawn(learned, generators),
            _drawn(predict_rounds(human, own, prior).cpu(), generators),
            chosen_log_probability(learned, own.to("cpu")).sum(-1),
        )
        del learned
        if test is not None:
            own = test.part(some)
            found = predict_rounds(human, own, posterior).cpu()
            part = replace(part, held_out=found.exp(), scores=score(found, own.to("cpu")))
        parts.append(part)
    report("predict", people, people, "people")
    return Predictions.joined(parts)


def predict_rounds(
    human: HumanModel, rounds: Demonstrations, draws: Mapping[str, Tensor]
) -> Tensor:
    """Log-probabilities ``[S, P, B, T, A]`` of actions, each given what was done before it.

    Args:
        human: the model of people.
        rounds: of P people.
        draws: of their implants ``[S, P, 1, ...]``.

    Raises:
        InputError: the rounds are of another domain, or the draws are none of these people.
        DemonstrationsError: the rounds cannot be in the domain's world.
        HumanModelError: the draws are not those of the model's sites.
    """
    check_rounds(human, rounds)
    draws = checked_draws(human, draws, rounds.num_people)
    if has_own_program(human):
        return Sequential(human, rounds).predict(draws)
    sizes = {site: len(support) for site, support in perceived_sites(human).items()}
    parts = []
    for some in _groups(rounds.num_people):
        own, recorded = _of_people(draws, some), rounds.part(some)
        # Only what some draw sees is looked at: exact views, without screening or merging.
        candidates = [
            combination_number({site: own[site][:, person, 0] for site in sizes}, sizes).unique()
            for person in range(len(some))
        ]
        table = build_view_table(human, recorded, candidates, likely=own, values=PREDICTED_VALUES)
        parts.append(predict_actions(human, table, own))
        if bool(parts[-1].isnan().any()):
            raise HumanModelError(f"{type(human).__name__}.act returns nan")
        del table
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)


def chosen_log_probability(log_probabilities: Tensor, rounds: Demonstrations) -> Tensor:
    """Log-probability ``[S, P, B, T]`` of what was done; 0 in padding."""
    actions = rounds.actions.clamp(min=0).expand(log_probabilities.shape[:-1])
    chosen = log_probabilities.gather(-1, actions[..., None]).squeeze(-1)
    return torch.where(rounds.mask, chosen, 0.0)


def _groups(people: int) -> list[range]:
    """Numbers of the people of each group; one person who would be left over joins the last.

    Arrays of a single person are taken in other blocks.
    """
    begins = list(range(0, people, PEOPLE_AT_ONCE))
    if len(begins) > 1 and people - begins[-1] == 1:
        begins.pop()
    return [range(*pair) for pair in zip(begins, [*begins[1:], people], strict=True)]


def _of_people(draws: Mapping[str, Tensor], some: range) -> dict[str, Tensor]:
    """Draws ``[S, P', 1, ...]`` of some people."""
    return {name: value[:, some.start : some.stop] for name, value in draws.items()}


def _drawn(log_probabilities: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
    """Actions ``[S, P, B, T]``, int8, by log-probabilities ``[S, P, B, T, A]``."""
    actions = []
    for person, generator in enumerate(generators):
        own = log_probabilities[:, person].exp()
        drawn = torch.multinomial(own.flatten(0, -2), 1, generator=generator)
        actions.append(drawn.view(own.shape[:-1]).to(torch.int8))
    return torch.stack(actions, 1)

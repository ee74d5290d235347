"""Summaries of a fit for each person, as in ``summary.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations

QUANTILES = {"median": 0.5, "q05": 0.05, "q95": 0.95}


def summarize(
    draws: Mapping[str, Tensor],
    train: Demonstrations,
    scores: Sequence[dict[str, Any] | None] | None,
    value_names: Mapping[str, Sequence[str]] | None = None,
) -> list[dict[str, Any]]:
    """Summarize each person: ``id``, ``rounds``, ``implants`` and ``test``.

    Args:
        draws: posterior draws ``[S, P, ...]``; only implants with one number per person are used.
        train: training rounds.
        scores: scores of each person's held-out rounds, see :func:`score`, if there are any.
        value_names: see `HumanModel.value_names`.

    Returns:
        ``implants``: by name ``median``, ``q05``, ``q95`` and ``truth`` (``None`` where unknown);
        quantiles are values that were drawn. Implants with named values have ``most_probable`` and
        its ``probability`` instead of quantiles. ``test``: ``nll`` in nats per action,
        ``accuracy`` and ``floor``, the person's own entropy (``None`` where unknown); ``None``
        without held-out rounds.
    """
    scalars = {name: value for name, value in draws.items() if value.dim() == 2}  # noqa: PLR2004
    return [
        {
            "id": name,
            "rounds": int(train.round_counts[person]),
            "implants": {
                site: _told(site, value[:, person], value_names or {})
                | {"truth": _truth(train, site, person)}
                for site, value in scalars.items()
            },
            "test": None if scores is None else scores[person],
        }
        for person, name in enumerate(train.people)
    ]


def summarize_newcomer(
    draws: Mapping[str, Tensor], value_names: Mapping[str, Sequence[str]] | None = None
) -> dict[str, dict[str, Any]]:
    """Summarize each scalar implant of a new person, from draws ``[S, ...]``."""
    return {
        site: _told(site, value, value_names or {})
        for site, value in draws.items()
        if value.dim() == 1
    }


def predictive(log_probabilities: Tensor) -> Tensor:
    """Log posterior predictive ``[P, B, T, A]`` of draws ``[S, P, B, T, A]``."""
    return torch.logsumexp(log_probabilities, 0) - np.log(len(log_probabilities))


def score(log_probabilities: Tensor, rounds: Demonstrations) -> list[dict[str, Any] | None]:
    """Negative log-likelihood, accuracy and floor of each person's actions.

    Args:
        log_probabilities: log-probabilities of actions ``[S, P, B, T, A]``.
        rounds: rounds of P people.

    Returns:
        One entry a person; ``None`` for those without rounds.
    """
    mixed = predictive(log_probabilities)
    actions = rounds.actions.clamp(min=0)
    chosen = mixed.gather(-1, actions[..., None]).squeeze(-1)
    right = mixed.argmax(-1) == actions
    results: list[dict[str, Any] | None] = []
    for person in range(rounds.num_people):
        steps = rounds.mask[person]
        if not steps.any():
            results.append(None)
            continue
        floor = None
        if rounds.action_entropy is not None:
            entropy = rounds.action_entropy[person][steps].mean()
            floor = None if entropy.isnan() else float(entropy)
        results.append(
            {
                "nll": float(-chosen[person][steps].mean()),
                "accuracy": float(right[person][steps].float().mean()),
                "floor": floor,
            }
        )
    return results


def _told(site: str, values: Tensor, value_names: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """Summary of a site, from draws ``[S]``."""
    if site not in value_names:
        return _quantiles(values)
    often = torch.bincount(values.long(), minlength=len(value_names[site])) / len(values)
    return {
        "most_probable": value_names[site][int(often.argmax())],
        "probability": float(often.max()),
    }


def _quantiles(values: Tensor) -> dict[str, float]:
    numbers = values.double().numpy()
    return {
        name: float(np.quantile(numbers, level, method="inverted_cdf"))
        for name, level in QUANTILES.items()
    }


def _truth(train: Demonstrations, site: str, person: int) -> float | None:
    if site not in train.truth or train.truth[site][person].isnan():
        return None
    return float(train.truth[site][person])

"""Comparison of human models by their posteriors' predictions of the same recordings.

Two measures of a round b of T actions, in nats; higher is better::

    loo      log p(a_b | all other rounds)                      rounds that were learned from
    heldout  sum_t log mean_s p(a_bt | psi_s, what came before) held-out rounds; psi_s: a draw

Leave-one-out is estimated by Pareto-smoothed importance sampling, in ArviZ (Vehtari, Gelman and
Gabry, *Practical Bayesian model evaluation using leave-one-out cross-validation and WAIC*, 2017).
Its estimate for a round is doubtful where few draws get most of the weight. Held-out rounds do not
have this problem: each action is predicted by the average over draws, as in ``nll`` of
``summary.json``.

Rounds are the sample: differences are paired by round, and the standard error of their sum is
``sqrt(rounds * variance)``, as in ``arviz.compare``. Sums and their errors are given per action.

Shapes: M models, S draws, P people, B rounds, T steps, A actions, N rounds of all people without
padding.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from mirror_ppl.arviz import az
from mirror_ppl.errors import PosteriorError
from mirror_ppl.evaluation.compared_files import FitFile, check_same, compared_model, source_of


@dataclass(frozen=True)
class Score:
    """Predictive scores of some rounds, in nats per action.

    Attributes:
        rounds: number of rounds.
        actions: number of actions in these rounds.
        log_density: mean log predictive density per action.
        log_density_se: its standard error; ``None`` for a single round.
        difference: to the ``log_density`` of the best model.
        difference_se: standard error of the difference, paired; ``None`` for a single round.
        doubtful: number of rounds with a doubtful leave-one-out estimate; ``None`` if held out.
    """

    rounds: int
    actions: int
    log_density: float
    log_density_se: float | None
    difference: float
    difference_se: float | None
    doubtful: int | None


@dataclass(frozen=True)
class RankedModel:
    """Result of one model in a comparison.

    Attributes:
        label: its name in the comparison.
        path: its posterior.
        human_model: its name in commands.
        weight: by stacking; the weights of all models sum to 1.
        good_k: Pareto k up to which leave-one-out is trusted; ``None`` if held out.
        total: over all rounds.
        people: over the rounds of each of the P people; ``None`` for those without any.
    """

    label: str
    path: Path
    human_model: str
    weight: float
    good_k: float | None
    total: Score
    people: tuple[Score | None, ...]


@dataclass(frozen=True)
class Comparison:
    """A comparison of models, from the best to the worst.

    Attributes:
        by: the measure, ``loo`` or ``heldout``.
        attributes: the domain, the setting and the provenance of the recordings.
        people: ids of the P people.
        models: M of them.
    """

    by: str
    attributes: Mapping[str, str]
    people: tuple[str, ...]
    models: tuple[RankedModel, ...]

    def table(self) -> pd.DataFrame:
        """Scores as `mirror_ppl.plots.comparison.plot_comparison` draws them."""
        return pd.DataFrame(
            [
                {"model": model.label, "person": person}
                | ({"rounds": 0} if score is None else asdict(score))
                for model in self.models
                for person, score in zip(
                    (None, *self.people), (model.total, *model.people), strict=True
                )
            ]
        ).astype({"difference_se": float})

    def as_data(self) -> dict[str, Any]:
        """The comparison as plain values for JSON, people by id."""
        return {
            "by": self.by,
            "unit": "nats an action",
            **self.attributes,
            "models": [
                {"rank": rank, "label": model.label, "posterior": str(model.path)}
                | {name: getattr(model, name) for name in ("human_model", "weight", "good_k")}
                | asdict(model.total)
                | {
                    "people": [
                        {"id": person} | ({"rounds": 0} if score is None else asdict(score))
                        for person, score in zip(self.people, model.people, strict=True)
                    ]
                }
                for rank, model in enumerate(self.models, 1)
            ],
        }


@dataclass(frozen=True)
class _Rounds:
    """A model's N rounds: log predictive densities, and which of them are doubtful."""

    values: np.ndarray
    doubtful: np.ndarray | None = None
    good_k: float | None = None


def compare_fits(files: Sequence[FitFile], labels: Sequence[str], by: str = "loo") -> Comparison:
    """Rank models by how well they predict rounds that they did not learn from.

    Args:
        files: one of each model, read for the same measure.
        labels: distinct names of the models.
        by: the measure, ``loo`` or ``heldout``.

    Raises:
        PosteriorError: files are of different recordings, or give recorded actions probability 0.
    """
    check_same(files)
    first = files[0]
    steps = (first.actions >= 0).sum(-1)
    real = steps > 0
    person, actions = np.nonzero(real)[0], steps[real]
    measure = _leave_one_out if by == "loo" else _held_out
    measured = {label: measure(file, real) for label, file in zip(labels, files, strict=True)}
    # Ties are ordered by name, so that the order of the arguments makes no difference.
    order = sorted(measured, key=lambda label: (-measured[label].values.sum(), label))
    weights = _stacking(np.stack([measured[label].values for label in order])).tolist()
    best = measured[order[0]].values
    people = [person == index for index in range(len(first.people))]

    def standing(label: str, weight: float) -> RankedModel:
        file, rounds = files[labels.index(label)], measured[label]
        return RankedModel(
            label,
            file.path,
            compared_model(file),
            weight,
            rounds.good_k,
            _score(rounds, best, actions, np.full(len(person), True)),
            tuple(_score(rounds, best, actions, own) if own.any() else None for own in people),
        )

    return Comparison(by, source_of(first), first.people, tuple(map(standing, order, weights)))


def _check_possible(file: FitFile, values: np.ndarray, real: np.ndarray) -> None:
    """Check that log-probabilities ``[N]`` or ``[S, N]`` are finite."""
    wrong = ~np.isfinite(values).reshape(-1, values.shape[-1]).all(0)
    if wrong.any():
        person, number = np.argwhere(real)[wrong.argmax()]
        raise PosteriorError(
            f"{file.path}: has no finite log-probability of what {file.people[person]} did in "
            f"round {number}, counted from 0"
        )


def _leave_one_out(file: FitFile, real: np.ndarray) -> _Rounds:
    likelihood = file.draws[:, real]
    _check_possible(file, likelihood, real)
    draws = xr.DataArray(likelihood[None], dims=("chain", "draw", "one"))
    data = az.InferenceData(log_likelihood=draws.to_dataset(name="action"))
    with warnings.catch_warnings():
        # ArviZ warns of doubtful rounds, which are counted here, and of a single round.
        warnings.simplefilter("ignore")
        # Draws are independent, so their relative efficiency is 1.
        loo = az.loo(data, pointwise=True, reff=1.0, scale="log")
    # Where all draws agree there is nothing to weight, though ArviZ finds no tail and gives up.
    # Elsewhere a k that is not a number counts as doubtful.
    doubtful = ~(loo.pareto_k.values <= loo.good_k) & (np.ptp(likelihood, axis=0) > 0)
    return _Rounds(loo.loo_i.values, doubtful, float(loo.good_k))


def _held_out(file: FitFile, real: np.ndarray) -> _Rounds:
    with np.errstate(divide="ignore"):
        predictive = np.log(file.draws.mean(0))
    values = np.where(file.actions >= 0, predictive, 0.0).sum(-1)[real]
    _check_possible(file, values, real)
    return _Rounds(values)


def _stacking(values: np.ndarray) -> np.ndarray:
    """Stacking weights ``[M]`` of the mixture that predicts rounds ``[M, N]`` best."""
    # A common factor changes no weight, and keeps densities of long rounds above 0.
    shifted = values - values.max(0)
    unused = {"se": np.nan, "p_loo": np.nan, "warning": False, "scale": "log"}
    sums: dict[str, Any] = {
        f"{model:03}": az.ELPDData({"elpd_loo": row.sum(), "loo_i": xr.DataArray(row)} | unused)
        for model, row in enumerate(shifted)
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table = az.compare(sums, method="stacking")
    weights = np.clip(table["weight"].sort_index().to_numpy(float), 0, 1)
    return weights / weights.sum()


def _score(rounds: _Rounds, best: np.ndarray, actions: np.ndarray, chosen: np.ndarray) -> Score:
    values, number = rounds.values[chosen], int(actions[chosen].sum())
    differences = values - best[chosen]
    return Score(
        rounds=len(values),
        actions=number,
        log_density=float(values.sum()) / number,
        log_density_se=_error(values, number),
        difference=float(differences.sum()) / number,
        difference_se=_error(differences, number),
        doubtful=None if rounds.doubtful is None else int(rounds.doubtful[chosen].sum()),
    )


def _error(values: np.ndarray, number: int) -> float | None:
    return float(np.sqrt(len(values) * values.var())) / number if len(values) > 1 else None

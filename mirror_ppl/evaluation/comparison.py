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

import os
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from mirror_ppl.arviz import az
from mirror_ppl.data.schema import TRUTH
from mirror_ppl.errors import PosteriorError
from mirror_ppl.inference.results.posterior_file import read_results
from mirror_ppl.models.loading import model_name

FILE = "posterior.nc"
"""File name of a fit's posterior."""
GROUPS = {
    "loo": ("log_likelihood", "observed_data", "constant_data"),
    "heldout": ("predictions", "observed_data", "constant_data", "predictions_constant_data"),
}
"""Groups of a posterior file that each measure reads; the measure needs the first."""
LACKS = {
    "loo": "has no log-likelihoods of the rounds that were learned from (group log_likelihood)",
    "heldout": "has no held-out rounds; leave some out of the fit (--train-rounds)",
}
"""The measures, and the message for a file without the data that they need."""
SOURCE = "recorded_"
"""Prefix of attributes that hold the provenance of recordings."""
LEAST_DRAWS = 2
"""Fewest draws for importance weights."""


@dataclass(frozen=True)
class FitFile:
    """Content of a posterior file that is compared.

    Attributes:
        path: the file.
        attributes: of the posterior.
        people: ids of the P people.
        recorded: arrays of the recordings, not of the model, by group and variable.
        actions: of the rounds that are compared ``[P, B, T]``; -1 in padding.
        draws: for leave-one-out log-likelihoods of whole rounds ``[S, P, B]``; for held-out rounds
            probabilities of the actions taken ``[S, P, B, T]``.
    """

    path: Path
    attributes: Mapping[str, str]
    people: tuple[str, ...]
    recorded: Mapping[str, np.ndarray]
    actions: np.ndarray
    draws: np.ndarray


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
        by: the measure, a key of `LACKS`.
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


def posterior_path(path: Path) -> Path:
    """Path of the posterior file, given the file or a fit's folder."""
    return path / FILE if os.path.isdir(path) else path


def read_fit(path: Path, by: str = "loo") -> FitFile:
    """Read the compared content of a posterior file.

    Args:
        path: a file that ``python -m mirror_ppl.fit`` wrote, or the folder that holds it.
        by: the measure, a key of `LACKS`.

    Raises:
        PosteriorError: the file is missing or damaged, or lacks the data of the measure.
    """
    path = posterior_path(path)
    data = read_results(path, "posterior", *GROUPS[by])
    try:
        attributes = {str(key): str(value) for key, value in data["posterior"].attrs.items()}
        file = _content(path, attributes, data, by) if GROUPS[by][0] in data else None
    except Exception as error:
        raise PosteriorError(f"{path}: cannot be read as a posterior ({error})") from error
    if file is None or not (file.actions >= 0).any():
        raise PosteriorError(f"{path}: {LACKS[by]}")
    power = float(attributes.get("likelihood_power", 1))
    if by == "loo" and power != 1:
        raise PosteriorError(
            f"{path}: each decision counts {power:g} times in it, so that no round can be left out "
            "of it by weighting; compare held-out rounds with --by heldout"
        )
    if len(file.draws) < (least := LEAST_DRAWS if by == "loo" else 1):
        raise PosteriorError(f"{path}: holds {len(file.draws)} draws, expected {least} or more")
    return file


def _content(
    path: Path, attributes: Mapping[str, str], data: Mapping[str, xr.Dataset], by: str
) -> FitFile:
    learned = data["observed_data"]["action"].transpose("person", "round", "step")
    recorded = {"observed_data action": learned.values} | _constants(data, "constant_data")
    if by == "loo":
        actions = learned.values
        values = data["log_likelihood"]["action"].transpose("chain", "draw", "person", "round")
        draws, rounds = _joined(values), actions.shape[:2]
    else:
        constants, order = data["predictions_constant_data"], ("person", "test_round", "step")
        actions = constants["observed_action"].transpose(*order).values
        recorded |= _constants(data, "predictions_constant_data")
        values = data["predictions"]["action_probability"]
        probability = _joined(values.transpose("chain", "draw", *order, "action_name"))
        chosen = np.maximum(actions, 0)[None, ..., None].astype(int)
        draws, rounds = np.take_along_axis(probability, chosen, -1)[..., 0], actions.shape
    if draws.shape[1:] != rounds:
        raise ValueError(f"rounds have shape {draws.shape[1:]}, expected {rounds}")
    people = tuple(map(str, data["observed_data"]["person"].values))
    return FitFile(path, attributes, people, recorded, actions, draws)


def _joined(values: xr.DataArray) -> np.ndarray:
    """Draws of all chains, one after the other, in double precision."""
    return values.values.reshape(-1, *values.shape[2:]).astype(float)


def _constants(data: Mapping[str, xr.Dataset], group: str) -> dict[str, np.ndarray]:
    """Recorded observations, messages and actions, without the truth of simulated people."""
    if group not in data:
        return {}
    return {
        f"{group} {name}": value.values
        for name, value in data[group].data_vars.items()
        if not str(name).startswith(TRUTH) and name != "action_entropy"
    }


def label_models(files: Sequence[FitFile]) -> tuple[str, ...]:
    """Label models by their names in commands and as much of their paths as distinguishes them."""
    models = [_model(file) for file in files]
    paths = [file.path.resolve() for file in files]
    # A fit's folder is used in place of the file in it, whose name is always the same.
    shown = [(path.parent if path.name == FILE else path).parts[1:] for path in paths]
    alike, labels = Counter(models), models
    for depth in range(1, 1 + max(map(len, shown))):
        if len(set(labels)) == len(set(paths)):
            break
        labels = [
            f"{model} {'/'.join(parts[-depth:])}" if alike[model] > 1 else model
            for model, parts in zip(models, shown, strict=True)
        ]
    # Only the same file, given more than once, still has no label of its own.
    again = Counter(labels)
    return tuple(
        f"{label} ({1 + labels[:place].count(label)})" if again[label] > 1 else label
        for place, label in enumerate(labels)
    )


def compare_fits(files: Sequence[FitFile], labels: Sequence[str], by: str = "loo") -> Comparison:
    """Rank models by how well they predict rounds that they did not learn from.

    Args:
        files: one of each model, read for the same measure.
        labels: distinct names of the models.
        by: the measure, a key of `LACKS`.

    Raises:
        PosteriorError: files are of different recordings, or give recorded actions probability 0.
    """
    for file in files[1:]:
        _check_same(files[0], file)
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
            _model(file),
            weight,
            rounds.good_k,
            _score(rounds, best, actions, np.full(len(person), True)),
            tuple(_score(rounds, best, actions, own) if own.any() else None for own in people),
        )

    return Comparison(by, _source(first), first.people, tuple(map(standing, order, weights)))


def _model(file: FitFile) -> str:
    return model_name(file.attributes.get("human_model", "unknown"))


def _source(file: FitFile) -> dict[str, str]:
    return {
        name: value
        for name, value in file.attributes.items()
        if name in ("domain", "setting") or name.startswith(SOURCE)
    }


def _check_same(first: FitFile, other: FitFile) -> None:
    expected, given = _source(first), _source(other)
    # The shortest difference is reported, rather than that of the command that recorded.
    # Where domains differ, everything else does, too.
    names = sorted(
        {*expected, *given},
        key=lambda name: (name != "domain", len(expected.get(name, "")), name),
    )
    different = f"{other.path}: is of other recordings than {first.path}:"
    for name in names:
        if given.get(name) != expected.get(name):
            raise PosteriorError(
                f"{different} {name} is {given.get(name)}, expected {expected.get(name)}"
            )
    if other.people != first.people:
        raise PosteriorError(
            f"{different} people are {', '.join(other.people)}, expected {', '.join(first.people)}"
        )
    for name, value in first.recorded.items():
        # A variable that one of the files lacks cannot contradict the other.
        own = other.recorded.get(name, value)
        if own.shape != value.shape:
            raise PosteriorError(
                f"{different} {name} has shape {own.shape}, expected {value.shape}; fit them with "
                "the same --train-rounds"
            )
        if not np.array_equal(own, value, equal_nan=value.dtype.kind == "f"):
            raise PosteriorError(f"{different} {name} differs")


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

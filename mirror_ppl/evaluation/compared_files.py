"""Reading of posterior files that are compared, and checks that they are of the same recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import xarray as xr

from mirror_ppl.data.schema import TRUTH
from mirror_ppl.errors import PosteriorError
from mirror_ppl.inference.results.posterior_file import POSTERIOR, posterior_at, read_results
from mirror_ppl.models.dependencies import ADDS_TO_ROUNDS
from mirror_ppl.models.loading import model_name
from mirror_ppl.models.simulation import OWN_HUMAN_MODEL

GROUPS = {
    "loo": ("log_likelihood", "observed_data", "constant_data"),
    "heldout": ("predictions", "observed_data", "constant_data", "predictions_constant_data"),
    "evidence": ("model_check", "observed_data", "constant_data"),
}
"""Groups of a posterior file that each measure reads; the measure needs the first."""
LACKS = {
    "loo": "has no log-likelihoods of the rounds that were learned from (group log_likelihood)",
    "heldout": "has no held-out rounds; leave some out of the fit (--train-rounds)",
    "evidence": "has no marginal likelihoods (log_evidence in the group model_check); fit again",
}
"""The measures, and the message for a file without the data that they need."""
SOURCE = "recorded_"
"""Prefix of attributes that hold the provenance of recordings."""
LEAST_DRAWS = 2
"""Fewest draws for importance weights."""


@dataclass(frozen=True)
class ComparedFile:
    """What all measures read of a posterior file.

    Attributes:
        path: the file.
        attributes: of the posterior.
        people: ids of the P people.
        recorded: arrays of the recordings, not of the model, by group and variable.
        actions: of the rounds that are compared ``[P, B, T]``; -1 in padding.
    """

    path: Path
    attributes: Mapping[str, str]
    people: tuple[str, ...]
    recorded: Mapping[str, np.ndarray]
    actions: np.ndarray


@dataclass(frozen=True)
class FitFile(ComparedFile):
    """A posterior file whose predictions are compared.

    Attributes:
        draws: for leave-one-out log-likelihoods of whole rounds ``[S, P, B]``; for held-out rounds
            probabilities of the actions taken ``[S, P, B, T]``.
    """

    draws: np.ndarray


@dataclass(frozen=True)
class EvidenceFile(ComparedFile):
    """A posterior file whose marginal likelihoods are compared.

    Attributes:
        log_evidence: log marginal likelihood of each person's recorded actions ``[P]``, nats.
        error: its standard error ``[P]``, nats.
    """

    log_evidence: np.ndarray
    error: np.ndarray


def read_fit(path: Path, by: str = "loo") -> FitFile:
    """Read the compared content of a posterior file.

    Args:
        path: a file that ``python -m mirror_ppl.fit`` wrote, or the folder that holds it.
        by: the measure, ``loo`` or ``heldout``.

    Raises:
        PosteriorError: the file is missing or damaged, or lacks the data of the measure.
    """
    file = _read(posterior_at(path), by, partial(_predictions, by=by))
    path, power = file.path, float(file.attributes.get("likelihood_power", 1))
    if by == "loo" and power != 1:
        raise PosteriorError(
            f"{path}: each decision counts {power:g} times in it, so that no round can be left out "
            "of it by weighting; compare held-out rounds with --by heldout"
        )
    if by == "loo" and file.attributes.get(ADDS_TO_ROUNDS):
        raise PosteriorError(
            f"{path}: act or round_latents of its human model has factors, observed sites, scales "
            "or masks, so that no round can be left out of it by weighting its actions; compare "
            "held-out rounds with --by heldout"
        )
    if len(file.draws) < (least := LEAST_DRAWS if by == "loo" else 1):
        raise PosteriorError(f"{path}: holds {len(file.draws)} draws, expected {least} or more")
    return file


def read_evidence(path: Path) -> EvidenceFile:
    """Read the marginal likelihoods of a posterior file.

    Args:
        path: a file that ``python -m mirror_ppl.fit`` wrote, or the folder that holds it.

    Raises:
        PosteriorError: the file is missing or damaged, or lacks the evidence of a person.
    """
    file = _read(posterior_at(path), "evidence", _evidence)
    power = float(file.attributes.get("likelihood_power", 1))
    unknown = [
        person
        for person, known in zip(file.people, np.isfinite(file.log_evidence), strict=True)
        if not known
    ]
    if unknown and power != 1:
        raise PosteriorError(
            f"{file.path}: each decision counts {power:g} times in it, so that it has no marginal "
            "likelihood; compare held-out rounds with --by heldout"
        )
    pooling = file.attributes.get("pooling", "none")
    if unknown and pooling != "none":
        raise PosteriorError(
            f"{file.path}: its people were pooled, or have a population as prior, so that they "
            "have no marginal likelihood of their own; compare them with --by loo or --by heldout"
        )
    if unknown:
        raise PosteriorError(
            f"{file.path}: holds no marginal likelihood of {', '.join(unknown)}; the engines "
            "importance, amortized and auto estimate it for people who are not pooled and models "
            "without factors or observed sites"
        )
    return file


Found = TypeVar("Found", bound=ComparedFile)


def _read(
    path: Path, by: str, content: Callable[[ComparedFile, Mapping[str, xr.Dataset]], Found | None]
) -> Found:
    data = read_results(path, "posterior", *GROUPS[by])
    try:
        attributes = {str(key): str(value) for key, value in data["posterior"].attrs.items()}
        learned = data["observed_data"]["action"].transpose("person", "round", "step").values
        recorded = {"observed_data action": learned} | _constants(data, "constant_data")
        people = tuple(map(str, data["observed_data"]["person"].values))
        shared = ComparedFile(path, attributes, people, recorded, learned)
        file = content(shared, data) if GROUPS[by][0] in data else None
    except Exception as error:
        raise PosteriorError(f"{path}: cannot be read as a posterior ({error})") from error
    if file is None or not (file.actions >= 0).any():
        raise PosteriorError(f"{path}: {LACKS[by]}")
    return file


def _evidence(shared: ComparedFile, data: Mapping[str, xr.Dataset]) -> EvidenceFile | None:
    check = data["model_check"]
    if "log_evidence" not in check:  # in files of earlier versions
        return None
    evidence, error = (check[name].values for name in ("log_evidence", "evidence_error"))
    if not evidence.shape == error.shape == (len(shared.people),):
        raise ValueError(f"evidences have shapes {evidence.shape} and {error.shape}")
    return EvidenceFile(**vars(shared), log_evidence=evidence, error=error)


def _predictions(shared: ComparedFile, data: Mapping[str, xr.Dataset], by: str) -> FitFile:
    actions, recorded = shared.actions, dict(shared.recorded)
    if by == "loo":
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
    return FitFile(shared.path, shared.attributes, shared.people, recorded, actions, draws)


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


def label_models(files: Sequence[ComparedFile]) -> tuple[str, ...]:
    """Label models by their names in commands and as much of their paths as distinguishes them."""
    models = [compared_model(file) for file in files]
    paths = [file.path.resolve() for file in files]
    # A fit's folder is used in place of the file in it, whose name is always the same.
    shown = [(path.parent if path.name == POSTERIOR else path).parts[1:] for path in paths]
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


def compared_model(file: ComparedFile) -> str:
    """Name of the human model in commands."""
    return model_name(file.attributes.get("human_model", "unknown"))


def source_of(file: ComparedFile) -> dict[str, str]:
    """Attributes of the recordings: domain, setting and provenance."""
    return {
        name: value
        for name, value in file.attributes.items()
        if name in ("domain", "setting") or name.startswith(SOURCE)
    }


def check_same(files: Sequence[ComparedFile]) -> None:
    """Check that all files are of the same recordings.

    Raises:
        PosteriorError: they are not; the message names a difference.
    """
    for file in files[1:]:
        _check_two(files[0], file)


def _recorded_alike(first: ComparedFile, other: ComparedFile) -> bool:
    """True if people and all that was recorded of them are the same."""
    return first.people == other.people and all(
        name in other.recorded
        and np.array_equal(other.recorded[name], value, equal_nan=value.dtype.kind == "f")
        for name, value in first.recorded.items()
    )


def _check_two(first: ComparedFile, other: ComparedFile) -> None:
    expected, given = source_of(first), source_of(other)
    # The shortest difference is reported, rather than that of the command that recorded.
    # Where domains differ, everything else does, too.
    own = f"{SOURCE}{OWN_HUMAN_MODEL}"  # the name of the population says more
    names = sorted(
        {*expected, *given},
        key=lambda name: (name != "domain", name == own, len(expected.get(name, "")), name),
    )
    different = f"{other.path}: is of other recordings than {first.path}:"
    if _recorded_alike(first, other):  # whatever is said of how they were made
        names = ["domain", "setting"]
    for name in names:
        if given.get(name) != expected.get(name):
            raise PosteriorError(
                f"{different} {name.removeprefix(SOURCE)} is {given.get(name, 'none')}, expected "
                f"{expected.get(name, 'none')}"
            )
    if other.people != first.people:
        raise PosteriorError(
            f"{different} people are {', '.join(other.people)}, expected "
            f"{', '.join(first.people)}; fit the same people with --people"
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

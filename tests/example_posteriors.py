"""Posteriors of four people in files, small enough to be scored by hand."""

import numpy as np
import xarray as xr

from mirror_ppl.arviz import az
from mirror_ppl.evaluation.compared_files import read_fit
from mirror_ppl.evaluation.comparison import compare_fits
from mirror_ppl.inference.results.export import save_inference_data

# Of four people: three rounds, two of them shorter; one round; none; three.
LENGTHS = np.array([[4, 2, 3], [4, 0, 0], [0, 0, 0], [1, 4, 4]])
PEOPLE = ("ana", "ben", "cem", "dia")
REAL = LENGTHS > 0
ACTIONS = np.where(np.arange(4) < LENGTHS[..., None], np.arange(4) % 2, -1).astype("int8")
SOURCE = {"recorded_seed": "0", "recorded_population": "paper", "recorded_command": "simulate " * 9}


def group(attributes, **variables):
    dataset = xr.Dataset({name: (dims.split(), value) for name, (dims, value) in variables.items()})
    return dataset.assign_coords(person=list(PEOPLE)).assign_attrs(attributes)


def write(
    path,
    likelihood=None,
    right=None,
    actions=ACTIONS,
    held_out=ACTIONS,
    ego=0.0,
    chains=1,
    evidence=None,
    **changes,
):
    """A file as a fit writes it.

    Args:
        likelihood: log-likelihoods ``[S, P, B]``, or ``[P, B]`` on which all of 30 draws agree.
        right: probabilities ``[S, P, B, T]`` of what was done in held-out rounds.
        actions, held_out: what was done ``[P, B, T]``.
        ego: what there was to see.
        evidence: log marginal likelihoods ``[P]`` and their errors; empty as in earlier versions.
        changes: other attributes than usual; ``None`` for none.
    """
    attributes = {"domain": "driving", "setting": "fog", "human_model": "HumanModel", **SOURCE}
    attributes |= changes
    attributes = {name: value for name, value in attributes.items() if value is not None}
    learned, out = "person round step", "person test_round step"
    shape = actions.shape
    groups = {
        "posterior": group(attributes, lapse=("chain draw person", np.zeros((1, 2, 4)))),
        "observed_data": group(attributes, action=(learned, actions)),
        "constant_data": group(
            attributes,
            ego=(learned, np.where(actions < 0, np.nan, ego)),
            truth_lapse=("person", np.full(4, len(changes))),
            action_entropy=(learned, np.full(shape, len(changes))),
        ),
    }
    if likelihood is not None:
        likelihood = np.asarray(likelihood, dtype=float)
        if likelihood.ndim == 2:
            likelihood = np.tile(likelihood, (30, 1, 1))
        dims = "chain draw person round"
        groups["log_likelihood"] = group(
            attributes, action=(dims, likelihood.reshape(chains, -1, *likelihood.shape[1:]))
        )
    if right is not None:
        # What is done at even steps is action 0, at odd ones 1; the rest is that of the other.
        flipped = np.arange(right.shape[-1]) % 2
        each = np.stack([np.where(flipped, 1 - right, right), np.where(flipped, right, 1 - right)])
        dims = f"chain draw {out} action_name"
        each = np.moveaxis(each, 0, -1)[None]
        groups["predictions"] = group(attributes, action_probability=(dims, each))
        groups["predictions_constant_data"] = group(attributes, observed_action=(out, held_out))
    if evidence is not None:
        checked = zip(
            ("nll", "log_evidence", "evidence_error"), (np.zeros(4), *evidence), strict=False
        )
        variables = {name: ("person", value) for name, value in checked}
        groups["model_check"] = group(attributes, **variables)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_inference_data(az.InferenceData(**groups), path)
    return path


def compared(*paths, by="loo", labels=None):
    files = [read_fit(path, by) for path in paths]
    return compare_fits(files, labels or [path.stem for path in paths], by)


def three_values(rng):
    """Log-likelihoods ``[M, P, B]`` of three models; the first is the best, the last the worst."""
    return -rng.uniform(0.1, 2.0, (3, 4, 3)) - np.array([0, 3, 6])[:, None, None]


def write_three(folder, values):
    names = ("a", "b", "c")
    return [write(folder / f"{n}.nc", value) for n, value in zip(names, values, strict=True)]


def standard_error(numbers):
    return np.sqrt(len(numbers)) * np.std(numbers)

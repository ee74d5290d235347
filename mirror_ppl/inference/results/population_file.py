"""The population in a posterior file: hyper-parameters, and a new person from it ("round zero").

There are two groups besides the standard ones. ``population``: for each discrete site the
probabilities of its values, ``<site>_probabilities``; for each continuous one mean and spread in
unconstrained space (of its logarithm or logit), ``<site>_mean`` and ``<site>_spread``.
``newcomer``: draws of the implants of a person from the population without recorded rounds.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import xarray as xr

from mirror_ppl.checks import as_path
from mirror_ppl.errors import PosteriorError
from mirror_ppl.inference.population.pooling import Pooling, Population
from mirror_ppl.inference.results.posterior_file import check_origin, read_results
from mirror_ppl.models.implants import in_units, is_reach

if TYPE_CHECKING:
    import arviz as az

SAMPLE = ("chain", "draw")


def add_population(
    data: az.InferenceData,
    pooling: Pooling,
    population: Population,
    attributes: Mapping[str, str | int | float],
    seed: int,
) -> dict[str, torch.Tensor]:
    """Add the groups ``population`` and ``newcomer`` to those of a fit.

    Args:
        data: groups of the fit.
        pooling: partial pooling of the human model.
        population: S draws.
        attributes: attributes of the file.
        seed: seed of the newcomer's draws.

    Returns:
        Draws ``[S, ...]`` of the newcomer, in the domain's units.
    """
    domain = pooling.human.domain
    variables: dict[str, tuple[tuple[str, ...], np.ndarray]] = {}
    coordinates = {}
    for name, probabilities in population.probabilities.items():
        axis = f"{name}_value"
        variables[f"{name}_probabilities"] = ((*SAMPLE, axis), probabilities.cpu().numpy()[None])
        values = pooling.supports[name].cpu()
        bins = torch.tensor(domain.reach_bins)
        coordinates[axis] = (bins[values] if is_reach(name, values) else values).numpy()
    for kind, part in (("mean", population.mean), ("spread", population.spread)):
        for name, value in part.items():
            variables[f"{name}_{kind}"] = (SAMPLE, value.cpu().numpy()[None])
    new = {name: value.cpu() for name, value in pooling.newcomers(population, 1, seed).items()}
    new = {name: value[:, 0] for name, value in in_units(domain, new).items()}
    newcomer = {}
    for name, value in new.items():
        axes = tuple(f"{name}_{axis}" for axis in range(value.dim() - 1))
        newcomer[name] = ((*SAMPLE, *axes), value.numpy()[None])
    own = {key: str(value) for key, value in attributes.items()}
    data.add_groups(
        {
            "population": xr.Dataset(variables, coordinates, own),
            "newcomer": xr.Dataset(newcomer, attrs=own),
        }
    )
    return new


def load_population(path: Path, pooling: Pooling, setting: str | None = None) -> Population:
    """Read the population of a posterior file, to be the prior of other people.

    Args:
        path: a file written by ``python -m mirror_ppl.fit --pooling partial``.
        pooling: partial pooling of the human model.
        setting: required setting of the population; any by default.

    Raises:
        PosteriorError: the file is missing or damaged, holds no population, or is of another human
            model, self-model, version of the domain or setting.
    """
    path = as_path(path)
    group = read_results(path, "population")["population"]
    attributes = {str(key): str(value) for key, value in group.attrs.items()}
    check_origin(path, attributes, pooling.human)
    if setting is not None and attributes.get("setting") != setting:
        raise PosteriorError(
            f"{path}: the population is of people in {attributes.get('setting')}, not in "
            f"{setting}; fit people in the same setting with --pooling partial"
        )
    like = next(pooling.human.parameters())

    def part(names: Mapping[str, object], kind: str, event: int) -> dict[str, torch.Tensor]:
        found = {}
        for name in names:
            if f"{name}_{kind}" not in group:
                raise PosteriorError(f'{path}: the population lacks "{name}_{kind}"')
            variable = group[f"{name}_{kind}"]
            if variable.dims[:2] != SAMPLE or variable.dtype.kind not in "iuf":
                raise PosteriorError(f'{path}: "{name}_{kind}" holds no draws of numbers')
            value = variable.values
            if value.ndim != len(SAMPLE) + event or not np.isfinite(value).all() or not value.size:
                raise PosteriorError(f'{path}: "{name}_{kind}" holds no numbers of a population')
            found[name] = torch.as_tensor(value.reshape(-1, *value.shape[2:])).to(like)
        return found

    probabilities = part(pooling.supports, "probabilities", 1)
    for name, value in probabilities.items():
        sums = value.sum(-1)
        if value.shape[1] != len(pooling.supports[name]) or (value <= 0).any():
            raise PosteriorError(
                f'{path}: "{name}_probabilities" are no probabilities of its values'
            )
        if not torch.allclose(sums, torch.ones_like(sums), atol=1e-3):
            raise PosteriorError(
                f'{path}: "{name}_probabilities" are no probabilities of its values'
            )
    spread = part(pooling.sites, "spread", 0)
    for name, value in spread.items():
        if (value <= 0).any():
            raise PosteriorError(f'{path}: "{name}_spread" has values that are not positive')
    return Population(probabilities, part(pooling.sites, "mean", 0), spread)

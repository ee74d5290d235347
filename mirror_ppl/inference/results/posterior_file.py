"""Reading of posterior files: draws of the implants, as the human model samples them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import xarray as xr
from torch import Tensor

from mirror_ppl.checks import as_path, require_kind, whole_number
from mirror_ppl.data.schema import TRUTH
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import InputError, PosteriorError
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import is_reach
from mirror_ppl.models.loading import human_models_of, model_name
from mirror_ppl.models.prior import sample_sites
from mirror_ppl.models.simulation import OWN_HUMAN_MODEL
from mirror_ppl.models.weights import fingerprint
from mirror_ppl.netcdf import read_netcdf
from mirror_ppl.randomness import forked

POSTERIOR = "posterior.nc"
"""Name of the file in the folder of a fit."""
BEFORE = {"value_error": "0"}
"""Attributes that files from before they were kept do not have."""


@dataclass(frozen=True)
class PosteriorFile:
    """Content of a posterior file of P people.

    Attributes:
        path: path of the file.
        attributes: attributes of the file: domain, setting, human model and so on.
        people: ids of the people.
        values: draws ``[S, P, ...]`` by name, in the units of the file.
        verdicts: the model check's verdict on each person, by id; none if the file has none.
        truth: true values ``[P]`` of sites, as recorded; NaN where they are unknown.
    """

    path: Path
    attributes: Mapping[str, str]
    people: tuple[str, ...]
    values: Mapping[str, np.ndarray]
    verdicts: Mapping[str, str] = field(default_factory=dict)
    truth: Mapping[str, np.ndarray] = field(default_factory=dict)

    def own_model(self, option: str) -> str:
        """Return the name of the package's human model that the posterior is of.

        Args:
            option: how to give another one, for the message.

        Raises:
            InputError: it is of a human model that the package does not have.
        """
        name = model_name(self.attributes.get("human_model", "unknown"))
        known = human_models_of(get_domain(self.attributes["domain"]))
        if name not in known or OWN_HUMAN_MODEL in self.attributes:
            own = self.attributes.get("human_model", "unknown")
            raise InputError(f"{self.path}: is of your own human model {own}; give it as {option}")
        return name

    def draws(self, human: HumanModel, number: int | None = None) -> dict[str, Tensor]:
        """Values ``[S, P, 1, ...]`` of all sites of a human model.

        Args:
            human: the human model of the posterior.
            number: number of draws, evenly spaced over those of the file; all by default.

        Raises:
            PosteriorError: the posterior is of another human model, self-model or version of the
                domain, holds fewer draws than requested, or impossible values.
            InputError: the human model or the number has another type.
        """
        require_kind(human, HumanModel, "human")
        check_origin(self.path, self.attributes, human)
        held = len(next(iter(self.values.values())))
        number = held if number is None else whole_number(number, "number", 0)
        if number > held:
            raise PosteriorError(
                f"{self.path}: holds {held} draws, not {number}: ask for {held} or fewer"
            )
        chosen = np.linspace(0, held - 1, number).round().astype(int)
        with forked():
            nodes = sample_sites(human, len(self.people))
        device = next(human.parameters()).device
        domain, draws = human.domain, {}
        bins = np.asarray(domain.reach_bins)
        for name, site in nodes.items():
            if name not in self.values:
                raise PosteriorError(f'{self.path}: has no draws of the site "{name}"')
            value = self.values[name][chosen]
            if value.dtype.kind not in "biuf":
                raise PosteriorError(f'{self.path}: "{name}" holds no numbers')
            if is_reach(name, site["value"]):
                distance = np.abs(value[..., None] - bins)
                if not (distance.min(-1) < np.diff(bins).min(initial=np.inf) / 2).all():
                    raise PosteriorError(f'{self.path}: "{name}" has values that are no bins')
                value = distance.argmin(-1)
            fn = site["fn"]
            shape = (number, len(self.people), 1, *fn.event_shape)
            if value.shape != shape[:2] + shape[3:]:
                raise PosteriorError(
                    f'{self.path}: "{name}" has shape {value.shape}, expected '
                    f"{shape[:2] + shape[3:]}"
                )
            own = torch.as_tensor(value.reshape(shape)).to(site["value"].dtype, copy=True)
            if number and not (own.isfinite().all() and fn.support.check(own).all()):
                raise PosteriorError(
                    f'{self.path}: "{name}" has values that the human model rules out'
                )
            draws[name] = own.to(device)
        return draws


def read_results(path: Path, *groups: str) -> dict[str, xr.Dataset]:
    """Read groups of a file that a fit wrote.

    Raises:
        PosteriorError: the file is missing or damaged, or lacks the first of the groups.
    """
    pooled = " --pooling partial" if groups[0] == "population" else ""
    hint = f"python -m mirror_ppl.fit{pooled} makes one"
    if not os.path.exists(path):
        raise PosteriorError(f"{path}: there is no such file; {hint}")
    data = read_netcdf(path, PosteriorError, groups)
    if groups[0] not in data:
        raise PosteriorError(f"{path}: holds no {groups[0]}; {hint}")
    return data


def check_origin(path: Path, attributes: Mapping[str, str], human: HumanModel) -> None:
    """Check that a file is of this human model.

    Raises:
        PosteriorError: it is of another domain or version of it, human model or self-model.
    """
    for name, mine in (
        ("domain", human.domain.name),
        ("domain_version", human.domain.version),
        ("human_model", type(human).__name__),
        ("self_model", fingerprint(human.self_model)),
        ("value_error", f"{human.domain.record.value_error:g}"),
    ):
        own = attributes.get(name, BEFORE.get(name))
        if own != mine:
            given = "what it was fitted with"
            if name == "human_model":
                own, mine = (model_name(str(one)) for one in (own, mine))
                given += " (--human-model; in Python human=)"
            mend = "fit again" if name == "value_error" else f"fit again, or give {given}"
            raise PosteriorError(
                f"{path}: is of {name.replace('_', ' ')} {own}, not {mine}; {mend}"
            )


def posterior_at(path: Path) -> Path:
    """Return the file of a posterior, given that or the folder of its fit."""
    return path / POSTERIOR if path.is_dir() else path


def load_posterior(path: Path, domain: str | None = None) -> PosteriorFile:
    """Read a posterior file.

    Args:
        path: a file that ``python -m mirror_ppl.fit`` or `save_inference_data` wrote, or the folder
            of a fit.
        domain: required domain; any by default.

    Raises:
        PosteriorError: the file is missing or damaged, holds no draws, or is of another domain.
        UnknownNameError: its domain does not exist.
    """
    path = as_path(path)
    path = posterior_at(path)
    groups = read_results(path, "posterior", "model_check", "constant_data")
    group, checked = groups["posterior"], groups.get("model_check", {})
    known = groups.get("constant_data", xr.Dataset())
    try:
        attributes = {str(name): str(value) for name, value in group.attrs.items()}
        people = tuple(map(str, group["person"].values))
        stacked = {
            str(name): value.transpose("chain", "draw", "person", ...).values
            for name, value in group.data_vars.items()
        }
        verdicts = {}
        if "verdict" in checked:
            verdicts = dict(zip(people, map(str, checked["verdict"].values), strict=True))
        truth = {
            str(name).removeprefix(TRUTH): value.values
            for name, value in known.data_vars.items()
            if str(name).startswith(TRUTH)
        }
    except Exception as error:
        raise PosteriorError(f"{path}: cannot be read as a posterior ({error})") from error
    own = attributes.get("domain", "unknown")
    if domain is not None and own != domain:
        raise PosteriorError(f'{path}: is for the domain "{own}", not "{domain}"')
    get_domain(own)
    values = {name: value.reshape(-1, *value.shape[2:]) for name, value in stacked.items()}
    if not values or min(len(value) for value in values.values()) == 0:
        raise PosteriorError(f"{path}: holds no draws")
    return PosteriorFile(path, attributes, people, values, verdicts, truth)

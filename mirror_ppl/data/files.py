"""Demonstrations as netCDF files; ``docs/demonstrations.md`` describes the format."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mirror_ppl.checks import as_path, require_kind
from mirror_ppl.data import schema
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.data.provenance import DESCRIPTION, RESERVED
from mirror_ppl.data.schema import MEASURED, OF_PERSON, TOLD, TRUTH
from mirror_ppl.domains import Domain, get_domain, require_known
from mirror_ppl.errors import DemonstrationsError, UnknownNameError, shown
from mirror_ppl.files import write_whole
from mirror_ppl.netcdf import made, read_netcdf

if TYPE_CHECKING:
    import xarray as xr

FORMAT = "mirror_ppl demonstrations"
FORMAT_VERSION = "1"
MANY, LONG = 12, 40
"""Most names, and most characters of a name, in a message."""

_LONG_NAMES = {
    "round_count": ("number of rounds; those from it on are padding", "rounds"),
    "length": ("number of actions of the round, 0 for padding", "steps"),
    "ego": ("the ego's features, always known", "as in the domain's description"),
    "action": ("action taken, -1 for padding", "index"),
    "control": (
        "executed control; action is the one nearest to it, nan for padding",
        "those of the control",
    ),
    "reward": ("task reward of the action, nan for padding", "units of reward"),
    "scenario": ("scenario of the round, -1 for padding or if unknown", "index"),
    "action_entropy": (
        "entropy of the choice that the simulated person made, nan for padding or if unknown",
        "nats",
    ),
}


def save_demonstrations(path: str | os.PathLike[str], demonstrations: Demonstrations) -> Path:
    """Write a netCDF-4 file, compressed, with checksums, whole or not at all.

    Returns:
        ``path``.

    Raises:
        OutputError: the file cannot be written.
    """
    path = as_path(path)
    dataset = to_dataset(require_kind(demonstrations, Demonstrations, "demonstrations"))
    packed = {"zlib": True, "complevel": 4, "shuffle": True, "fletcher32": True}
    encoding = {str(name): packed for name in dataset.data_vars}
    return write_whole(path, made(dataset.to_netcdf(engine="h5netcdf", encoding=encoding)))


def load_demonstrations(
    path: str | os.PathLike[str], domain: str | None = None, setting: str | None = None
) -> Demonstrations:
    """Read a netCDF file (netCDF-4, or the older netCDF-3).

    Args:
        path: the file.
        domain: domain that the file must be of; if given, the file need not name it.
        setting: setting that the file must be of, likewise.

    Raises:
        UnknownNameError: ``domain``, or ``setting`` as one of ``domain``, is unknown.
        DemonstrationsError: the file is missing, damaged or not netCDF, or its content is not
            valid; one line that names the file and the fault.
    """
    if domain is not None and setting is not None:
        require_known(setting, "setting", get_domain(domain).settings, domain)
    elif domain is not None:
        get_domain(domain)
    path = as_path(path)
    dataset = read_netcdf(path, DemonstrationsError)["/"]
    unnamed = "format" not in dataset.attrs
    if unnamed and read_netcdf(path, DemonstrationsError, ("posterior",)):
        raise DemonstrationsError(f"{path} is a posterior, not recordings")
    try:
        return from_dataset(dataset, domain, setting)
    except (DemonstrationsError, UnknownNameError) as error:
        raise DemonstrationsError(f"{path}: {error}") from error


def to_dataset(demonstrations: Demonstrations) -> xr.Dataset:
    """Make a dataset with named dimensions, coordinates and units, in the smallest exact dtypes."""
    import xarray as xr

    domain = get_domain(demonstrations.domain)
    dimensions = schema.variable_dimensions(domain)
    variables = {}
    for name, value in demonstrations.variables().items():
        dims = dimensions.get(name, ("person",))
        variables[name] = (dims, _smallest(value.cpu().numpy()), _attributes(domain, name))
    labels = {"person": demonstrations.people, **schema.dimension_labels(domain)}
    return xr.Dataset(
        variables,
        coords={name: (name, np.array(entries, dtype=object)) for name, entries in labels.items()},
        attrs={
            "title": f"Demonstrations: {domain.name}, {demonstrations.setting}",
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "domain": domain.name,
            "domain_version": domain.version,
            "setting": demonstrations.setting,
            **demonstrations.provenance,
        },
    )


def from_dataset(
    dataset: xr.Dataset, domain: str | None = None, setting: str | None = None
) -> Demonstrations:
    """Read demonstrations from a dataset, whatever software made it.

    Dimensions may be in any order, and so may items and features if they are named; dtypes may be
    any numeric ones. Variables that the format does not know are ignored.

    Args:
        dataset: in the documented format.
        domain: domain that it must be of; if given, the dataset need not name it.
        setting: setting that it must be of, likewise.

    Raises:
        UnknownNameError: the domain or setting is unknown.
        DemonstrationsError: the dataset is not in the format, or its values are not valid.
    """
    for name, expected in (("format", FORMAT), ("format_version", FORMAT_VERSION)):
        if name not in dataset.attrs:
            raise DemonstrationsError(f"attribute {name} is missing, expected {expected!r}")
        given = str(dataset.attrs[name])
        if given != expected:
            raise DemonstrationsError(f"attribute {name} is {given!r}, expected {expected!r}")
    domain_name = _agreed(dataset, "domain", domain)
    world = get_domain(domain_name)
    setting = require_known(
        _agreed(dataset, "setting", setting), "setting", world.settings, world.name
    )
    version = str(dataset.attrs.get("domain_version", world.version))
    if version != world.version:
        raise DemonstrationsError(
            f"the recordings are of version {version} of {domain_name}, expected {world.version}; "
            "rounds of another version may mean something else"
        )
    _check_meaning(dataset, world)
    dataset = _in_order(dataset, schema.dimension_labels(world))
    dimensions = schema.variable_dimensions(world)
    for name in map(str, dataset.data_vars):
        if name.startswith(OF_PERSON):
            dimensions[name] = ("person",)
        elif name.startswith(TOLD) and name not in dimensions:
            known = ", ".join(other for other in dimensions if other.startswith(TOLD))
            raise DemonstrationsError(f"unknown variable {name}, expected {known}")
    variables = {
        name: _tensor(dataset[name], dims)
        for name, dims in dimensions.items()
        if name in dataset.variables
    }
    if "length" in variables:
        # Software that joins rounds of different lengths often marks absent ones by nan.
        variables["length"] = variables["length"].nan_to_num(0)
    if "person" in dataset.coords:
        kind = dataset["person"].dtype
        times = " since " in str(dataset["person"].attrs.get("units"))
        if kind.kind not in "OSUiub" or times:
            what = "times" if times else f"the dtype {kind}"
            raise DemonstrationsError(f"person has ids of {what}, expected text")
        people = _texts(dataset["person"])
    else:
        people = map(str, range(dataset.sizes.get("person", 0)))
    return Demonstrations.from_variables(
        domain_name, setting, tuple(people), variables, _provenance(dataset.attrs)
    )


def _agreed(dataset: xr.Dataset, name: str, wanted: str | None) -> str:
    given = dataset.attrs.get(name)
    if given is None and wanted is None:
        raise DemonstrationsError(f"attribute {name} is missing")
    if given is not None and wanted is not None and str(given) != wanted:
        raise DemonstrationsError(f"attribute {name} is {str(given)!r}, expected {wanted!r}")
    return str(given) if wanted is None else wanted


def _check_meaning(dataset: xr.Dataset, world: Domain) -> None:
    """Refuse numbers that mean something else by what the dataset says of them."""
    kinds = dict.fromkeys(("action", "scenario"), "flag_meanings")
    kinds |= dict.fromkeys((modality.name for modality in world.modalities), "units")
    for name, kind in kinds.items():
        given = dataset[name].attrs.get(kind) if name in dataset else None
        expected = _attributes(world, name)[kind]
        if given is not None and str(given) != expected:
            raise DemonstrationsError(f"{kind} of {name} are {str(given)!r}, expected {expected!r}")
    for name in ("round", "step", "time"):
        values = dataset[name].values if name in dataset.coords else np.empty(0)
        if values.dtype.kind in "iuf" and values.ndim == 1 and not (np.diff(values) > 0).all():
            raise DemonstrationsError(f"the coordinate {name} does not increase")


def _in_order(dataset: xr.Dataset, labels: Mapping[str, tuple[str, ...]]) -> xr.Dataset:
    """Put a dataset's items and features, where they are named, into the domain's order."""
    for dimension, expected in labels.items():
        if dimension in dataset.coords:
            given = _texts(dataset[dimension])
            if sorted(given) != sorted(expected):
                odd = [name for name in given if name not in expected] or given
                raise DemonstrationsError(
                    f"{dimension} has {_listed(odd)}, expected {_listed(expected)}"
                )
            dataset = dataset.isel({dimension: [given.index(name) for name in expected]})
    return dataset


def _listed(names: Sequence[str]) -> str:
    """Names for a message, on one line, cut to the first ones."""
    some = [name if name.isprintable() and len(name) <= LONG else shown(name) for name in names]
    return ", ".join(some[:MANY] + [f"... ({len(some)} in all)"] * (len(some) > MANY))


def _texts(array: xr.DataArray) -> list[str]:
    entries = np.atleast_1d(array.values).ravel().tolist()
    try:
        return [entry.decode() if isinstance(entry, bytes) else str(entry) for entry in entries]
    except UnicodeDecodeError as error:
        raise DemonstrationsError(f"{array.name} has names that are not UTF-8") from error


def _tensor(array: xr.DataArray, dimensions: tuple[str, ...]) -> Tensor:
    if set(array.dims) != set(dimensions):
        raise DemonstrationsError(
            f"{array.name} has the dimensions {', '.join(map(str, array.dims)) or 'none'}, "
            f"expected {', '.join(dimensions)}"
        )
    values = array.transpose(*dimensions).values
    if values.dtype.kind not in "biuf":
        raise DemonstrationsError(f"{array.name} has the dtype {values.dtype}, expected numbers")
    with np.errstate(invalid="ignore"):  # for values that are not numbers, and stay so
        values = values.astype(np.float64 if values.dtype.kind == "f" else np.int64)
    return torch.from_numpy(values)


def _provenance(attributes: Mapping[str, object]) -> dict[str, str | int | float]:
    """Select attributes that are one text or number and do not describe the format."""
    provenance = {}
    for name, value in attributes.items():
        plain = value.item() if isinstance(value, np.generic) else value
        if name not in (*DESCRIPTION, *RESERVED) and type(plain) in (str, int, float):
            provenance[str(name)] = plain
    return provenance


def _smallest(values: np.ndarray) -> np.ndarray:
    """Convert values to the smallest dtype that holds them."""
    if values.dtype.kind in "iu":
        kinds = (np.int8, np.int16, np.int32, np.int64)
        return values.astype(
            next(
                kind
                for kind in kinds
                if np.iinfo(kind).min <= values.min() and values.max() <= np.iinfo(kind).max
            )
        )
    if values.dtype == bool:
        return values.astype(np.int8)
    single = values.astype(np.float32)
    return single if np.array_equal(single, values, equal_nan=True) else values


def _attributes(domain: Domain, name: str) -> dict[str, object]:
    if name.startswith(TRUTH):
        implant = name.removeprefix(TRUTH)
        long_name = f"true value of the implant {implant}, nan if unknown"
        return {"long_name": long_name, "units": "those of the implant"}
    if name.startswith(MEASURED):
        site = name.removeprefix(MEASURED)
        long_name = f"measured value of the site {site} of the human model, nan if unknown"
        return {"long_name": long_name, "units": "those of the site"}
    if name.startswith(TOLD):
        modality = name.removeprefix(TOLD)
        long_name = f"whether the {modality} item was communicated just before the action"
        return {"long_name": long_name, "units": "1", **_flags(("not_told", "told"))}
    for modality in domain.modalities:
        if name == modality.name:
            return {
                "long_name": f"all that could be observed of the {name} items, nan for padding",
                "units": ", ".join(modality.units),
                "comment": f"units in the order of {name}_feature; "
                "what of it the person saw is not recorded",
            }
    long_name, units = _LONG_NAMES[name]
    flags = {"action": domain.actions, "scenario": domain.scenarios}.get(name)
    return {"long_name": long_name, "units": units, **(_flags(flags) if flags else {})}


def _flags(names: tuple[str, ...]) -> dict[str, object]:
    """Names of whole numbers by the CF conventions: words, separated by spaces."""
    words = [re.sub(r"[^\w.+@-]+", "_", name) for name in names]
    return {
        "flag_values": _smallest(np.arange(len(names))),
        "flag_meanings": " ".join(words),
    }

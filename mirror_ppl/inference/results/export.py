"""Posteriors as ArviZ ``InferenceData``, saved as netCDF.

Groups: ``posterior`` and ``prior`` (implants of each person; sight in the domain's unit of
distance), ``posterior_predictive``, ``prior_predictive``, ``observed_data`` and ``log_likelihood``
(actions of the training rounds), ``predictions`` (probabilities of the actions of held-out
rounds), ``constant_data`` and ``predictions_constant_data`` (observations, and the truth where it
is known). Attributes hold the domain, setting, model and version.

Predictive draws are of each action given the recorded history before it: their averages are
comparable with recorded actions, their spread within a round is not.

Draws are independent and not a chain, so effective sample sizes and r-hat are meaningless for them,
except for those of the engine ``nuts`` and of pooled people, which follow a chain.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.data.schema import TRUTH
from mirror_ppl.domains import get_domain
from mirror_ppl.files import write_whole
from mirror_ppl.inference.results.criticism import NLLS
from mirror_ppl.inference.results.identifiability import Identifiability
from mirror_ppl.inference.results.predictions import Predictions
from mirror_ppl.models.implants import SIGHT, in_units
from mirror_ppl.netcdf import made

if TYPE_CHECKING:
    import arviz as az


def to_inference_data(
    train: Demonstrations,
    test: Demonstrations | None,
    posterior: Mapping[str, Tensor],
    prior: Mapping[str, Tensor],
    predicted: Predictions,
    attributes: Mapping[str, str | int | float],
) -> az.InferenceData:
    """Collect the results of a fit.

    Args:
        train: training rounds.
        test: held-out rounds, if there are any.
        posterior: draws ``[S, P, 1, ...]``.
        prior: draws ``[S', P, 1, ...]``.
        predicted: predictions of actions.
        attributes: attributes of the file.
    """
    # Imported here, as it takes longer than all else that a command that fits nothing imports.
    from mirror_ppl.arviz import az

    domain = get_domain(train.domain)

    def group(values: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
        return {name: value.numpy()[None] for name, value in values.items()}

    held_out = {}
    if test is not None and predicted.held_out is not None:
        held_out["predictions"] = group({"action_probability": predicted.held_out})
        held_out["predictions_constant_data"] = _constants(test)
    data = az.from_dict(
        posterior=group(in_units(domain, posterior)),
        prior=group(in_units(domain, prior)),
        posterior_predictive=group({"action": predicted.posterior}),
        prior_predictive=group({"action": predicted.prior}),
        observed_data={"action": train.actions.numpy().astype("int8")},
        log_likelihood=group({"action": predicted.log_likelihood}),
        constant_data=_constants(train),
        **held_out,
        coords={
            "person": list(train.people),
            "direction": list(domain.directions),
            "action_name": list(domain.actions),
            **{f"{m.name}_item": list(m.items) for m in domain.modalities},
            **{f"{m.name}_feature": list(m.features) for m in domain.modalities},
        },
        dims=_dims([*posterior, *prior, *(TRUTH + name for name in train.truth)], train.told),
        attrs={key: str(value) for key, value in attributes.items()},
    )
    if test is not None:
        # In from_dict a variable has the same dimensions in each group.
        data.rename({"round": "test_round"}, groups="predictions_constant_data", inplace=True)
    for name in data.groups():
        data[name].attrs.update({key: str(value) for key, value in attributes.items()})
        for variable in data[name].data_vars:
            if str(variable).startswith(SIGHT):
                data[name][variable].attrs["units"] = domain.reach_unit
    return data


def add_identifiability(
    data: az.InferenceData, found: Identifiability, attributes: Mapping[str, str | int | float]
) -> None:
    """Add the group ``identifiability`` to those of a fit; its variables are in nats.

    Args:
        data: groups of the fit.
        found: posterior entropies and expected information gains of its people.
        attributes: attributes of the file.
    """
    domain = get_domain(str(attributes["domain"]))
    scenarios = list(domain.scenarios)[: found.information.shape[1]]
    by_site, by_scenario = ("person", "site"), ("person", "scenario")
    variables = {
        "entropy": (by_site, found.entropy),
        "shared_with_policy": (by_site, found.shared),
        "entropy_together": (("person",), found.all_entropy),
        "shared_with_policy_together": (("person",), found.all_shared),
        "information": (by_scenario, found.information),
        "information_error": (by_scenario, found.information_error),
    }
    group = xr.Dataset(
        {name: (dims, value.cpu().numpy()) for name, (dims, value) in variables.items()},
        {
            "person": data["posterior"]["person"].values,
            "site": list(found.sites),
            "scenario": scenarios,
        },
        {key: str(value) for key, value in attributes.items()},
    )
    for name in group.data_vars:
        group[name].attrs["units"] = "nats"
    data.add_groups({"identifiability": group})


def add_check(
    data: az.InferenceData,
    people: Sequence[Mapping[str, Any]],
    attributes: Mapping[str, str | int | float],
) -> None:
    """Add the group ``model_check`` to those of a fit: verdicts, p-values, evidence of each person.

    Args:
        data: groups of the fit.
        people: their parts of the summary, with ``check``, ``test`` and perhaps ``log_evidence``.
        attributes: attributes of the file.
    """
    checks = [person["check"] for person in people]
    names = list(dict.fromkeys(name for check in checks for name in check["p_values"]))
    values = [[check["p_values"].get(name, math.nan) for name in names] for check in checks]
    nats: dict[str, list[float | None]] = {
        "nll": [(one["test"] or {}).get("nll") for one in people],
        **{name: [one[name] for one in checks] for name in NLLS},
        **{name: [one.get(name) for one in people] for name in ("log_evidence", "evidence_error")},
    }
    group = xr.Dataset(
        {
            "verdict": (("person",), [check["verdict"] for check in checks]),
            "p_value": (("person", "check"), np.array(values).reshape(len(checks), len(names))),
            **{name: (("person",), np.array(own, dtype=float)) for name, own in nats.items()},
        },
        {"person": data["posterior"]["person"].values, "check": names},
        {key: str(value) for key, value in attributes.items()},
    )
    for name in nats:
        group[name].attrs["units"] = "nats"
    data.add_groups({"model_check": group})


def save_inference_data(data: az.InferenceData, path: Path) -> None:
    """Write netCDF, compressed, with checksums, whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    write_whole(path, netcdf_content(data))


def netcdf_content(inference_data: az.InferenceData) -> memoryview:
    """Content of its netCDF file; numbers are compressed and have checksums."""
    data = inference_data.to_datatree()
    packing = {"zlib": True, "complevel": 1, "shuffle": True, "fletcher32": True}
    encoding = {
        group.path: {
            name: packing
            for name, variable in group.variables.items()
            if variable.dtype.kind in "biuf" and variable.ndim
        }
        for group in data.subtree
    }
    content = data.to_netcdf(engine="h5netcdf", encoding=encoding)
    assert isinstance(content, memoryview)  # as no path was given
    return made(content)


def _constants(rounds: Demonstrations) -> dict[str, Any]:
    constants: dict[str, Any] = {
        "observed_action": rounds.actions.numpy().astype("int8"),
        "ego": rounds.ego.numpy(),
        **{name: value.numpy() for name, value in rounds.observations.items()},
    }
    constants |= {f"told_{name}": mask.numpy().astype("int8") for name, mask in rounds.told.items()}
    constants |= {TRUTH + name: value.numpy() for name, value in rounds.truth.items()}
    if rounds.action_entropy is not None:
        constants["action_entropy"] = rounds.action_entropy.numpy()
    return constants


def _dims(one_a_person: Iterable[str], modalities: Iterable[str]) -> dict[str, list[str]]:
    rounds = ["person", "round", "step"]
    dims = {name: ["person"] for name in one_a_person}
    dims["residual_in"] = ["person", "residual_input", "residual_unit"]
    dims["residual_out"] = ["person", "residual_unit_and_bias", "action_name"]
    dims["action"] = rounds
    dims["action_probability"] = ["person", "test_round", "step", "action_name"]
    dims["observed_action"] = dims["action_entropy"] = rounds
    dims["ego"] = ["person", "round", "time", "ego_feature"]
    for modality in modalities:
        item = f"{modality}_item"
        dims[f"told_{modality}"] = [*rounds, item]
        dims[modality] = ["person", "round", "time", item, f"{modality}_feature"]
    return dims

"""Files of amortized guides: safetensors, with a card in the metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mirror_ppl.checks import require_kind
from mirror_ppl.data import asset_path
from mirror_ppl.errors import AssetError, OtherPriorError
from mirror_ppl.files import json_text
from mirror_ppl.inference.amortized_guide import AmortizedGuide, reference_places
from mirror_ppl.inference.engines import ENGINES
from mirror_ppl.likelihood.densities import require_compilable
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import model_name
from mirror_ppl.models.variants import VARIANTS
from mirror_ppl.models.weights import fingerprint, read_tensors, save_tensors

FORMAT = "mirror_ppl guide 3"
BEFORE = {"likelihood_power": "1"}
"""Metadata that files from before they were kept do not have."""
FIRST = next(iter(VARIANTS))


def shipped_guide(domain: str, human_model: str = FIRST) -> Path:
    """Path of the guide that ships for a domain and one of the package's human models.

    Args:
        domain: name of the domain.
        human_model: a name in `mirror_ppl.models.variants.VARIANTS`.

    Raises:
        AssetError: no guide ships for them.
    """
    which = "" if human_model == FIRST else f"_{human_model.replace('-', '_')}"
    return asset_path(f"{domain}_guide{which}.safetensors")


def save_guide(
    guide: AmortizedGuide, human: HumanModel, path: Path, card: Mapping[str, Any]
) -> None:
    """Write a guide and its card: how it was trained, and its quality.

    Raises:
        OutputError: the file cannot be written.
    """
    metadata = {"format": FORMAT, **_belongs_to(human), "card": json_text(card)}
    save_tensors(path, guide.state_dict(), metadata)


def _belongs_to(human: HumanModel) -> dict[str, str]:
    """Metadata that identify the human model of a guide."""
    return {
        "domain": human.domain.name,
        "domain_version": human.domain.version,
        "human_model": type(human).__name__,
        "likelihood_power": f"{human.likelihood_power:g}",
        "self_model": fingerprint(human.self_model),
    }


def load_guide(path: Path, human: HumanModel) -> tuple[AmortizedGuide, dict[str, Any]]:
    """Read a guide, ready for use, and its card.

    Args:
        path: a file written by :func:`save_guide`.
        human: the human model that the guide has to be for.

    Raises:
        AssetError: the file is missing or damaged, or is for another human model, self-model,
            domain or version of it.
    """
    require_kind(human, HumanModel, "human")
    metadata, tensors = read_tensors(path, {FORMAT: "guide"})
    for name, own in _belongs_to(human).items():
        found = metadata.get(name, BEFORE.get(name))
        if found != own:
            if name == "human_model":
                found, own = model_name(str(found)), model_name(own)
            raise AssetError(
                f"{path}: is for {name.replace('_', ' ')} {found}, not {own}; "
                "train a guide for it, or use the engine importance"
            )
    try:
        card = json.loads(metadata["card"])
        places = reference_places(human)
        guide = AmortizedGuide(places)
        guide.load_state_dict(tensors)
    except (KeyError, RuntimeError, ValueError) as error:
        raise AssetError(f"{path}: does not fit this program ({error})") from error
    if not guide.reads(places):
        raise OtherPriorError(
            f"{path}: is for another prior; train a guide for this one, or use the engine "
            "importance"
        )
    return guide.eval().to(next(human.parameters()).device), card


def network_for(engine: str, path: Path | None, human: HumanModel) -> AmortizedGuide | None:
    """Load the network of an engine: from a file, or the one that ships; else ``None``.

    Raises:
        AssetError: the file cannot be read or is for another human model; or the engine needs a
            network and none ships.
        HumanModelError: the engine needs a network, and this human model cannot have one.
    """
    if not ENGINES[engine].takes_network:
        return None
    if ENGINES[engine].needs_network:
        require_compilable(human)
    if path is None:
        own = [name for name, kind in VARIANTS.items() if kind is type(human)]
        if not ENGINES[engine].needs_network:
            return _shipped_network(human, own)
        try:
            path = shipped_guide(human.domain.name, own[0] if own else FIRST)
        except AssetError as error:
            name, world = model_name(type(human).__name__), human.domain.name
            which = f" --human-model {own[0]}" if own and own[0] != FIRST else ""
            raise AssetError(
                f"no guide ships for {name} in {world}: train one with python -m mirror_ppl.train "
                f"--what guide --domain {world}{which} and name it with --guide-file, or use "
                "--guide importance"
            ) from error
    return load_guide(path, human)[0]


def _shipped_network(human: HumanModel, names: Sequence[str]) -> AmortizedGuide | None:
    """The network that ships for exactly this human model and self-model, or ``None``."""
    try:
        path = shipped_guide(human.domain.name, names[0])
    except (AssetError, IndexError):
        return None
    metadata, _ = read_tensors(path, {FORMAT: "guide"})
    if _belongs_to(human).items() <= {**BEFORE, **metadata}.items():
        with suppress(OtherPriorError):
            return load_guide(path, human)[0]
    return None

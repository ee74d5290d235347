"""Saves and loads weights of self-models: safetensors files, with a card in their metadata."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safetensors.torch import load, save
from torch import Tensor, nn

from mirror_ppl.checks import as_path
from mirror_ppl.data import asset_path
from mirror_ppl.domains import DOMAINS, get_domain
from mirror_ppl.domains.registry import code_of
from mirror_ppl.errors import AssetError, MirrorError, StaleSelfModel
from mirror_ppl.files import json_text, read_whole, write_whole
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import Sizes
from mirror_ppl.randomness import forked

FORMAT = "mirror_ppl self-model 1"
CHECKSUM = "checksum"
"""Key in a file's metadata of the checksum of everything else in the file."""
SELF_MODEL = "self_model"
"""Key in recordings' provenance of the fingerprint of the people's self-model."""
HEADER = 8
"""Bytes at the beginning of a safetensors file that hold the length of its header."""


def shipped_weights(domain: str) -> Path:
    """Return the path of a domain's shipped weights, or of those that `train` wrote.

    Raises:
        AssetError: there are none.
    """
    name = f"{domain}_self_model.safetensors"
    if domain in DOMAINS:
        return asset_path(name)
    if not (trained := Path("runs") / name).exists():
        raise AssetError(
            f"{trained}: there is no self-model of {domain} yet; make one with python -m "
            "mirror_ppl.train --domain path/to/file.py:Class, or name its file with --self-model"
        )
    return trained


def fingerprint(network: nn.Module) -> str:
    """Return a fingerprint of a network's weights: the beginning of their hash."""
    digest = hashlib.sha256()
    for name, value in sorted(network.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def save_self_model(self_model: SelfModel, path: Path, card: Mapping[str, Any]) -> None:
    """Write weights and their card, with training settings and accuracy.

    Raises:
        OutputError: the file cannot be written.
    """
    metadata = {
        "format": FORMAT,
        "domain": self_model.domain.name,
        "domain_version": self_model.domain.version,
        "domain_code": code_of(self_model.domain),
        "sizes": json.dumps(asdict(self_model.sizes)),
        "card": json_text(card),
    }
    save_tensors(path, self_model.state_dict(), metadata)


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a safetensors file with a checksum of its content.

    Raises:
        OutputError: the file cannot be written.
    """
    own = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    write_whole(path, save(own, {**metadata, CHECKSUM: _checksum(own, metadata)}))


def read_tensors(path: Path, kinds: Mapping[str, str]) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Read the metadata and tensors of a safetensors file.

    Args:
        path: the file.
        kinds: allowed values of ``"format"`` in the metadata, with a name for messages.

    Raises:
        AssetError: the file is missing, damaged or of another format.
    """
    path = as_path(path)
    content = read_whole(path, AssetError)
    try:
        tensors = load(content)
        header = content[HEADER : HEADER + int.from_bytes(content[:HEADER], "little")]
        metadata: dict[str, str] = json.loads(header).get("__metadata__", {})
    # A damaged file can raise nearly any exception.
    except Exception as error:
        raise AssetError(f"{path}: cannot be read as weights ({error})") from error
    if metadata.get("format") not in kinds:
        raise AssetError(f"{path}: not a {' or '.join(kinds.values())} of this program")
    checksum = metadata.pop(CHECKSUM, None)
    if checksum is None:
        raise AssetError(
            f"{path}: has no checksum; version 0.1.0 wrote none, train the network again"
        )
    if checksum != _checksum(tensors, metadata):
        raise AssetError(f"{path}: is damaged, its checksum is not that of its content")
    for name, value in tensors.items():
        if not value.isfinite().all():
            raise AssetError(f"{path}: {name} has values that are not finite numbers")
    return metadata, tensors


def _checksum(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    digest = hashlib.sha256(json.dumps(sorted(metadata.items())).encode())
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()


def read_card(path: Path, kinds: Mapping[str, str]) -> dict[str, Any]:
    """Read the card of a safetensors file; see :func:`read_tensors`."""
    metadata, _ = read_tensors(path, kinds)
    try:
        return json.loads(metadata["card"])
    except (KeyError, ValueError) as error:
        raise AssetError(f"{path}: does not fit this program ({error})") from error


def load_self_model(path: Path, domain: str | None = None) -> tuple[SelfModel, dict[str, Any]]:
    """Read a self-model, in evaluation mode, and its card.

    Args:
        path: a file of :func:`save_self_model`.
        domain: name of the required domain; any unless given.

    Raises:
        AssetError: the file is missing or damaged, or is for another domain or version of it.
    """
    metadata, tensors = read_tensors(path, {FORMAT: "self-model"})
    if domain is not None and metadata["domain"] != domain:
        raise AssetError(f'{path}: is for the domain "{metadata["domain"]}", not "{domain}"')
    try:
        world = get_domain(metadata["domain"])
        if metadata["domain_version"] != world.version:
            raise AssetError(
                f"{path}: is for version {metadata['domain_version']} of {world.name}, "
                f"this is version {world.version}"
            )
        if metadata.get("domain_code", "") != code_of(world):
            warnings.warn(
                f"{path}: the file of {world.name} has changed since this self-model was trained; "
                "train it again unless that changes nothing",
                StaleSelfModel,
                stacklevel=2,
            )
        sizes = Sizes(**json.loads(metadata["sizes"])) if "sizes" in metadata else None
        with forked():
            self_model = SelfModel(world, sizes, embedding=None)
        self_model.load_state_dict(tensors)
        card = json.loads(metadata["card"])
    except (KeyError, RuntimeError, TypeError, ValueError, MirrorError) as error:
        if isinstance(error, AssetError):
            raise
        raise AssetError(f"{path}: does not fit this program ({error})") from error
    return self_model.eval(), card

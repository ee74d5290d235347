"""Human models from files of other people, and what such a class has to offer."""

from __future__ import annotations

import os
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path

from mirror_ppl.checks import require_kind
from mirror_ppl.errors import HumanModelError
from mirror_ppl.models.bomb_defusal import BombDefusalHuman
from mirror_ppl.models.bomb_defusal_variants import (
    BombDefusalAnyKind,
    BombDefusalHardOfHearing,
    BombDefusalLate,
    BombDefusalNoImplants,
    BombDefusalPerceptualOnly,
    BombDefusalPolicyOnly,
    BombDefusalPreferring,
)
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.variants import VARIANTS
from mirror_ppl.user_code import class_in_file, describe

MIRROR = "mirror"
"""The package's own model; which it is depends on the domain."""
OWN: Mapping[str, Mapping[str, type[HumanModel]]] = {
    "bomb_defusal": {
        MIRROR: BombDefusalHuman,
        "perceptual-only": BombDefusalPerceptualOnly,
        "policy-only": BombDefusalPolicyOnly,
        "no-implants": BombDefusalNoImplants,
        "late": BombDefusalLate,
        "preferring": BombDefusalPreferring,
        "hard-of-hearing": BombDefusalHardOfHearing,
        "all": BombDefusalAnyKind,
    }
}
"""What names in ``VARIANTS`` stand for in domains that need another model than `HumanModel`."""


def model_name(class_name: str) -> str:
    """What commands call a human model of that class; of somebody's own the name of the class."""
    for variants in (VARIANTS, *OWN.values()):
        for name, kind in variants.items():
            if kind.__name__ == class_name:
                return name
    return class_name


def file_of(specification: str | None) -> Path | None:
    """Of ``path/to/file.py:Class`` the file; the package's own models have none."""
    if specification is None or specification in VARIANTS:
        return None
    return Path(specification.rpartition(":")[0])


def load_human_model(
    specification: str | os.PathLike[str] | None, self_model: SelfModel
) -> HumanModel:
    """Make a human model.

    Args:
        specification: a name in ``VARIANTS``, or ``path/to/file.py:Class``, a class derived from
            :class:`HumanModel`; the package's own model unless given.
        self_model: the robot's networks.

    Raises:
        HumanModelError: the file or class is missing, does not import, or is not a human model.
    """
    if isinstance(specification, os.PathLike):
        specification = os.fspath(specification)
    if specification is not None:
        require_kind(specification, str, "specification")
    if specification is None or specification in VARIANTS:
        require_kind(self_model, SelfModel, "self_model")
        name = specification or MIRROR
        return OWN.get(self_model.domain.name, {}).get(name, VARIANTS[name])(self_model)
    path_text, colon, name = specification.rpartition(":")
    if not colon or not name.isidentifier():
        close = get_close_matches(specification.lower(), VARIANTS, n=1)
        raise HumanModelError(
            f'"{specification}" is not of the form path/to/file.py:Class, and none of '
            f"{', '.join(VARIANTS)}" + "".join(f'; perhaps you meant "{name}"' for name in close)
        )
    path = Path(path_text)
    chosen = class_in_file(path, name, HumanModel, HumanModelError)
    try:
        return chosen(self_model)
    except (Exception, SystemExit) as error:
        raise HumanModelError(f"{name} cannot be made: {describe(error, path)}") from error

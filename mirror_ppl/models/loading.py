"""Loads human models by name or from users' files."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path

from mirror_ppl.checks import require_kind
from mirror_ppl.domains.base import Domain
from mirror_ppl.domains.registry import known_domains
from mirror_ppl.errors import HumanModelError, LacksSitesOfWorld, MisspeltMember
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.variants import VARIANTS
from mirror_ppl.user_code import class_in_file, describe, misspelt

MIRROR = "mirror"
"""Name of the package's own model, which depends on the domain."""


def model_name(class_name: str) -> str:
    """Return the name that commands use for a class; for a user's class its own name."""
    for variants in (VARIANTS, *map(human_models_of, known_domains())):
        for name, kind in variants.items():
            if kind.__name__ == class_name:
                return name
    return class_name


def model_names() -> tuple[str, ...]:
    """Names of the package's human models, of which some are of one domain only."""
    own = (human_models_of(domain) for domain in known_domains())
    return tuple(dict.fromkeys(name for names in (VARIANTS, *own) for name in names))


def human_models_of(domain: Domain) -> Mapping[str, type[HumanModel]]:
    """Return the package's human models by name, with those of the domain."""
    return {**VARIANTS, **domain.record.part("human_models")}


def checked_base(human: HumanModel) -> HumanModel:
    """Return a user's human model, with warnings about its base class and misspelt methods.

    Warns:
        LacksSitesOfWorld: the world has a human model of its own, whose sites this one lacks.
        MisspeltMember: a method almost has the name of one that the model could override.
    """
    for name, meant in misspelt(type(human)).items():
        warnings.warn(
            f"{name} of {type(human).__name__} is no member of human models, and nothing calls it "
            f"unless you do; perhaps you meant {meant}",
            MisspeltMember,
            stacklevel=3,
        )
    own = human.self_model.domain.record.part("human_models")
    if MIRROR in own and not isinstance(human, tuple(own.values())):
        needed = own[MIRROR]
        warnings.warn(
            f"{type(human).__name__} lacks the sites in which people of "
            f"{human.self_model.domain.name} differ; derive it from {needed.__module__}."
            f"{needed.__name__}",
            LacksSitesOfWorld,
            stacklevel=3,
        )
    return human


def file_of(specification: str | None) -> Path | None:
    """Return the file in ``path/to/file.py:Class``; None for the package's own models."""
    if specification is None or specification in model_names():
        return None
    return Path(specification.rpartition(":")[0])


def load_human_model(
    specification: str | os.PathLike[str] | None, self_model: SelfModel
) -> HumanModel:
    """Make a human model.

    Args:
        specification: a name of :func:`model_names`, or ``path/to/file.py:Class``, a class derived
            from :class:`HumanModel`; the package's own model unless given.
        self_model: the robot's networks.

    Raises:
        HumanModelError: the file or class is missing, does not import, or is not a human model; or
            the domain has no model of that name.
    """
    if isinstance(specification, os.PathLike):
        specification = os.fspath(specification)
    if specification is not None:
        require_kind(specification, str, "specification")
    names = model_names()
    if specification is None or specification in names:
        require_kind(self_model, SelfModel, "self_model")
        name, domain = specification or MIRROR, self_model.domain
        offered = human_models_of(domain)
        if name not in offered:
            others = ", ".join(one.name for one in known_domains() if name in human_models_of(one))
            raise HumanModelError(f"{name}: {domain.name} has no such human model, only {others}")
        return offered[name](self_model)
    path_text, colon, name = specification.rpartition(":")
    if not colon or not name.isidentifier():
        close = get_close_matches(specification.lower(), names, n=1)
        raise HumanModelError(
            f'"{specification}" is not of the form path/to/file.py:Class, and none of '
            f"{', '.join(names)}" + "".join(f'; perhaps you meant "{name}"' for name in close)
        )
    path = Path(path_text)
    chosen = class_in_file(path, name, HumanModel, HumanModelError)
    try:
        human = chosen(self_model)
    except (Exception, SystemExit) as error:
        raise HumanModelError(f"{name} cannot be made: {describe(error, path)}") from error
    return checked_base(human)

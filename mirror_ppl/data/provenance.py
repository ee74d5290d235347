"""Provenance of recordings: texts and numbers that a file keeps as its attributes."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

import numpy as np

from mirror_ppl.errors import DemonstrationsError, is_name, shown

DESCRIPTION = ("title", "Conventions", "format", "format_version", "domain", "setting")
DESCRIPTION += ("domain_version",)
"""Attributes of a file that describe it; all others are provenance."""
RESERVED = ("NAME", "CLASS", "DIMENSION_LIST", "REFERENCE_LIST", "_NCProperties", "_nc3_strict")
RESERVED += ("_Netcdf4Dimid", "_Netcdf4Coordinates")
"""Attributes that are reserved by netCDF-4."""


def checked_provenance(provenance: Any) -> dict[str, str | int | float]:
    """Convert provenance to plain texts and numbers.

    Raises:
        DemonstrationsError: it is not a dict, or has a name or a value that a file cannot keep.
    """
    if not isinstance(provenance, Mapping):
        raise DemonstrationsError(f"provenance must be a dict, not {shown(provenance)}")
    result = {}
    for name, value in provenance.items():
        if name in DESCRIPTION:
            raise DemonstrationsError(f"provenance has {name}, which describes the file itself")
        if name in RESERVED:
            raise DemonstrationsError(f"provenance has {name}, which netCDF keeps for itself")
        if not is_name(name):
            raise DemonstrationsError(f"provenance has {shown(name)}, expected names as text")
        plain = value.item() if isinstance(value, np.generic) else value
        if isinstance(plain, bool) or not isinstance(plain, str | int | float):
            raise DemonstrationsError(
                f"provenance {name} is {shown(value)}, expected text or a number"
            )
        if isinstance(plain, str) and not _can_be_written(plain):
            raise DemonstrationsError(
                f"provenance {name} is {shown(plain)}, expected text that can be written in UTF-8"
            )
        if isinstance(plain, int) and not -(2**63) <= plain < 2**63:
            raise DemonstrationsError(
                f"provenance {name} is {shown(plain)}, expected a whole number of 64 bits"
            )
        if isinstance(plain, float) and not isfinite(plain):
            raise DemonstrationsError(f"provenance {name} is {plain}, expected a finite number")
        result[name] = plain
    return result


def _can_be_written(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return "\0" not in text

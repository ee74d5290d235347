"""A family of human models that differ from the package's own model in one respect each.

Each is one file and can be fitted, simulated and calibrated; :class:`AnyKind` is their mixture.
"""

from mirror_ppl.models.family.any_kind import KIND, AnyKind, OneOfKinds, model_of
from mirror_ppl.models.family.forgetting import FORGETS, Forgetting
from mirror_ppl.models.family.hearing import HEARS, HardOfHearing
from mirror_ppl.models.family.late import LATE, Late
from mirror_ppl.models.family.noticing import NOTICES, Noticing
from mirror_ppl.models.family.preferring import PREFERS, SHARES_GOAL, Preferring
from mirror_ppl.models.family.several import SeveralBeliefs

__all__ = [
    "FORGETS",
    "HEARS",
    "KIND",
    "LATE",
    "NOTICES",
    "PREFERS",
    "SHARES_GOAL",
    "AnyKind",
    "Forgetting",
    "HardOfHearing",
    "Late",
    "Noticing",
    "OneOfKinds",
    "Preferring",
    "SeveralBeliefs",
    "model_of",
]

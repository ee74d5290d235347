"""A family of human models: people who differ from the package's own model in one respect.

Each is a file of its own, to fit, simulate and calibrate; :class:`AnyKind` is all of them at once.
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

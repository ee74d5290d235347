"""MIRROR as a Pyro program: what a person sees, how they decide, and what a robot should tell them.

::

    import mirror_ppl

    recordings = mirror_ppl.load_recordings("recordings.nc")
    fit = mirror_ppl.infer(recordings)
    fit.plot.sight()
    moment = mirror_ppl.RoundSoFar.of(recordings, "person-01", number=3, step=5)
    decision = mirror_ppl.Communicator(fit, "person-01").plan(moment)

The models are in `mirror_ppl.models`, the ways to fit them in `mirror_ppl.inference`, the worlds in
`mirror_ppl.domains`. Modules are imported on first use, so that `import mirror_ppl` stays quick;
only Gymnasium (0.06 s beyond numpy) is imported, to register the worlds.
"""

from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

from gymnasium import register as _register

from mirror_ppl.version import __version__ as __version__

if _TYPE_CHECKING:
    from mirror_ppl.face import (
        Communicator,
        Companion,
        Fit,
        HumanModel,
        Recorder,
        RoundSoFar,
        World,
        add_domain,
        infer,
        load_recordings,
        worlds,
    )

__all__ = [
    "Communicator",
    "Companion",
    "Fit",
    "HumanModel",
    "Recorder",
    "RoundSoFar",
    "World",
    "add_domain",
    "infer",
    "load_recordings",
    "worlds",
]

for _folder, _name in (
    ("driving", "Driving"),
    ("search_rescue", "SearchRescue"),
    ("bomb_defusal", "BombDefusal"),
    ("highway", "Highway"),
):
    _register(f"mirror_ppl/{_name}-v0", f"mirror_ppl.domains.{_folder}.environment:{_name}Env")


def __getattr__(name: str) -> _Any:
    if name in __all__:
        from mirror_ppl import face

        return getattr(face, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

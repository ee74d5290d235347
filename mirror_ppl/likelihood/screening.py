"""When combinations of discrete implants are given up while rounds are compiled."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Screening:
    """When a combination of discrete implants is given up.

    Attributes:
        margin: nats by which its log-likelihood may fall behind the best one's, each under the
            policy that suits it best.
        policies: number of policies: of draws of the implants from the prior.
        seed: seed of those draws.
        resolution: moments of a round are merged when the log-probabilities of what was done there,
            each under ``merge_policies`` of those policies, fall on the same points of a grid of
            this width. 0 for never.
        merge_policies: see there.
    """

    margin: float = 15.0
    policies: int = 16
    seed: int = 0
    resolution: float = 0.03
    merge_policies: int = 16

    def __post_init__(self) -> None:
        for name, least in (
            ("margin", 0),
            ("policies", 1),
            ("resolution", 0),
            ("merge_policies", 1),
        ):
            if not getattr(self, name) >= least:
                raise ValueError(f"{name} must be at least {least}, not {getattr(self, name)}")

"""Settings of screening: when combinations of what perception reads are dropped."""

from __future__ import annotations

from dataclasses import dataclass

from mirror_ppl.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Screening:
    """Settings of screening, which drops combinations of what perception reads during compilation.

    Attributes:
        margin: nats by which a combination's log-likelihood may fall behind the best one's, each
            under its best policy, after many rounds.
        early: nats by which the margin is larger after the first round. After n rounds it is
            ``margin + early / n``, since later rounds can contradict early ones.
        policies: number of policies, which are draws of the implants from the prior. Others near
            the person are added to them (:mod:`mirror_ppl.likelihood.likely_policies`).
        seed: seed of those draws.
        resolution: grid width for merging moments of a round: they are merged if their recorded
            actions' log-probabilities under ``merge_policies`` policies round to the same grid
            points. 0 for never.
        merge_policies: number of policies in that comparison.
    """

    margin: float = 15.0
    early: float = 25.0
    policies: int = 16
    seed: int = 0
    resolution: float = 0.03
    merge_policies: int = 16

    def __post_init__(self) -> None:
        for name, least in (
            ("margin", 0),
            ("early", 0),
            ("policies", 1),
            ("resolution", 0),
            ("merge_policies", 1),
        ):
            if not getattr(self, name) >= least:
                raise InputError(f"{name} must be at least {least}, not {getattr(self, name)}")

    def margin_after(self, rounds: int) -> float:
        """Return the margin after some rounds."""
        return self.margin + self.early / rounds

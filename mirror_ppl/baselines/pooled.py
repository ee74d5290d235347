"""Joining of all people's rounds as those of one person, for baselines that people share."""

from __future__ import annotations

from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.data.schema import OF_PERSON

EVERYBODY = "everybody"
"""Id of the person to whom all rounds are assigned."""


def as_one_person(rounds: Demonstrations) -> Demonstrations:
    """Join all people's rounds, one after the other, as those of one person.

    Truths and measurements are left out.
    """
    real = rounds.lengths > 0  # [P, B]
    variables = {
        name: value[real][None]
        for name, value in rounds.variables().items()
        if name != "round_count" and not name.startswith(OF_PERSON)
    }
    return Demonstrations.from_variables(
        rounds.domain, rounds.setting, [EVERYBODY], variables, rounds.provenance
    )

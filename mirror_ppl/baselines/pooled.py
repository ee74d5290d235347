"""Rounds of everybody as those of one person, for baselines that people share."""

from __future__ import annotations

from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.data.schema import OF_PERSON

EVERYBODY = "everybody"
"""The id of the one person whose rounds are those of all."""


def as_one_person(rounds: Demonstrations) -> Demonstrations:
    """Everybody's rounds, one after the other, as those of one person.

    What is known of people beside their rounds, truths and measurements, is left out.
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

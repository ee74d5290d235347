"""Checks that a human model can be fitted to recordings, or queried about them."""

from __future__ import annotations

from typing import Any

from mirror_ppl.checks import require_kind
from mirror_ppl.data import Demonstrations
from mirror_ppl.data.contradictions import check_observations
from mirror_ppl.errors import InputError
from mirror_ppl.models.human import HumanModel


def check_rounds(human: Any, rounds: Any, people: int | None = None) -> None:
    """Check that a human model and recordings match.

    Args:
        human: the model of people.
        rounds: `Demonstrations`.
        people: required number of people; any unless given.

    Raises:
        InputError: an argument is of another kind; the recordings are of another domain or number
            of people.
        DemonstrationsError: an observation is impossible in the domain.
    """
    require_kind(human, HumanModel, "human")
    require_kind(rounds, Demonstrations, "the rounds")
    if rounds.domain != human.domain.name:
        raise InputError(f"the rounds are of {rounds.domain}, not of {human.domain.name}")
    if people is not None and rounds.num_people != people:
        wanted = "one" if people == 1 else people
        raise InputError(f"the rounds are of {rounds.num_people} people, not {wanted}")
    check_observations(rounds)

"""What recordings have to be so that a human model can be fitted to them, or asked about them."""

from __future__ import annotations

from typing import Any

from mirror_ppl.checks import require_kind
from mirror_ppl.data import Demonstrations
from mirror_ppl.data.contradictions import check_observations
from mirror_ppl.errors import InputError
from mirror_ppl.models.human import HumanModel


def check_rounds(human: Any, rounds: Any, people: int | None = None) -> None:
    """Make sure that a human model and recordings go together.

    Args:
        human: the model of people.
        rounds: `Demonstrations`.
        people: number of people that they have to be of; any unless given.

    Raises:
        InputError: one of them is something else; the recordings are of another domain, or of
            another number of people.
        DemonstrationsError: an observation cannot be in the domain's world.
    """
    require_kind(human, HumanModel, "human")
    require_kind(rounds, Demonstrations, "the rounds")
    if rounds.domain != human.domain.name:
        raise InputError(f"the rounds are of {rounds.domain}, not of {human.domain.name}")
    if people is not None and rounds.num_people != people:
        wanted = "one" if people == 1 else people
        raise InputError(f"the rounds are of {rounds.num_people} people, not {wanted}")
    check_observations(rounds)

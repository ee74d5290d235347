"""Pairings of people with communicators, as cells that can run in parallel."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path

from mirror_ppl.communication.communicator import NOT_EXPLAINED
from mirror_ppl.communication.person import Person
from mirror_ppl.communication.planners import PLANNERS
from mirror_ppl.domains import Domain, get_domain
from mirror_ppl.domains.registry import code_of
from mirror_ppl.errors import PosteriorError
from mirror_ppl.evaluation.assistance import (
    RATES_FROM,
    Listener,
    PlannerOptions,
    listeners,
    play_together,
    speaker,
)
from mirror_ppl.evaluation.played import Played
from mirror_ppl.inference.results.criticism import UNEXPLAINED
from mirror_ppl.inference.results.posterior_file import PosteriorFile, load_posterior
from mirror_ppl.jobs import JsonFormat, Runner
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.limits import LIMITS
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import file_of, load_human_model
from mirror_ppl.models.simulation import PRIOR_OF
from mirror_ppl.models.weights import SELF_MODEL, fingerprint, load_self_model, shipped_weights
from mirror_ppl.people import PeopleOfHumanModel, SimulatedPeople, simulated_people
from mirror_ppl.randomness import number_of
from mirror_ppl.version import __version__

TOGETHER, PLANNED_TOGETHER = 5, 2
"""People who play together, and with planners: a step of many takes hardly longer than one of few,
but planners decide one after the other, and fewer together let more processes work at once."""


@dataclass(frozen=True)
class Pairing:
    """Description of pairings and rounds, from which any process can run a cell.

    Attributes:
        posterior: file of the people's posterior.
        human_model: of the fit, if it is none of the package's.
        self_model: of the fit; that which ships unless given.
        draws: posterior draws to plan with.
        setting, population, people_seed: arguments that simulate the people.
        people: ids of the people who are assisted, some of the posterior's.
        rounds: number of rounds of each person.
        planner: settings of the planners.
        seed: of the rounds and of everything random.
        keep_log: True to keep every decision.
        people_model: human model from whose prior the people were drawn, if it is a user's.
        plan_anyway: True to plan messages for people whom the model does not explain, too.
    """

    posterior: Path
    human_model: str | None
    self_model: Path | None
    draws: int
    setting: str
    population: str
    people_seed: int
    people: tuple[str, ...]
    rounds: int
    planner: PlannerOptions
    seed: int
    keep_log: bool
    people_model: str | None = None
    plan_anyway: bool = False

    @cached_property
    def file(self) -> PosteriorFile:
        """The posterior."""
        return load_posterior(self.posterior)

    @property
    def domain(self) -> Domain:
        """The world."""
        return get_domain(self.file.attributes["domain"])

    @cached_property
    def human(self) -> HumanModel:
        """The human model that the posterior is of."""
        weights = self.self_model or shipped_weights(self.domain.name)
        self_model, _ = load_self_model(weights, self.domain.name)
        name = self.human_model or self.file.own_model("--human-model FILE.py:CLASS")
        return load_human_model(name, self_model)

    @property
    def _simulated(self) -> int:
        """Number of simulated people up to the last one who is assisted."""
        return max(self.numbers.values()) + 1

    def everybody(self) -> SimulatedPeople:
        """Return the simulated people, up to the last one who is assisted."""
        return simulated_people(
            self.domain.name,
            self.setting,
            self.population,
            self._simulated,
            self.people_seed,
            self_model=self.self_model,
            human_model=self.people_model,
        )

    @cached_property
    def numbers(self) -> dict[str, int]:
        """The number of each person among the simulated people, from 0, by id.

        Raises:
            PosteriorError: a person's id is none that simulated people have.
        """
        found = {person: number_of(person) for person in self.people}
        if others := [person for person, number in found.items() if number is None]:
            raise PosteriorError(
                f"{self.posterior}: the id {others[0]} is none of simulated people (person-01, "
                "person-02, ...), so that it is unknown who is to be played"
            )
        numbers = {person: number for person, number in found.items() if number is not None}
        _, most = LIMITS["people"]
        if max(numbers.values()) >= most:
            raise PosteriorError(f"{self.posterior}: ids are above {most}, the most people")
        return numbers

    def check(self) -> None:
        """Check that posterior, human model and self-model match, before any work is done.

        Raises:
            MirrorError: they do not match.
        """
        check_contract(self.human)
        self.file.draws(self.human, self.draws)
        simulated = self.file.attributes.get(f"recorded_{SELF_MODEL}")
        if simulated not in (None, fingerprint(self.human.self_model)):
            raise PosteriorError(
                f"{self.posterior}: its people were simulated with another self-model "
                f"({simulated}); simulate and fit them anew with this one"
            )
        everybody = self.everybody()
        if isinstance(everybody, PeopleOfHumanModel) and self.people_model != self.human_model:
            check_contract(everybody.human)
        for site, value in everybody.truth().items():
            for person, number in self.numbers.items():
                self._check_truth(person, site, float(value[number]))

    def _check_truth(self, person: str, site: str, expected: float) -> None:
        """Refuse a person who is recorded with another true value of a site."""
        if site not in self.file.truth:
            return
        recorded = float(self.file.truth[site][self.file.people.index(person)])
        if math.isnan(recorded) or math.isclose(recorded, expected, rel_tol=1e-4):
            return
        version = ", or was drawn by another version of this package"
        raise PosteriorError(
            f"{self.posterior}: {person} is not that of the population {self.population} with seed "
            f"{self.people_seed}{version if self.population.startswith(PRIOR_OF) else ''}: {site} "
            f"is {recorded:.4g} in the recordings, not {expected:.4g}"
        )

    @property
    def unexplained(self) -> tuple[str, ...]:
        """Ids of the people whose actions the human model does not explain."""
        return tuple(name for name in self.people if self.file.verdicts.get(name) == UNEXPLAINED)

    def listeners(self, people: Sequence[str], inferred: bool = True) -> list[Listener]:
        """Return people by id, with their rounds and their posteriors."""
        everybody = self.everybody()
        everyone = listeners(everybody, self._simulated, self.setting, self.rounds, self.seed)
        chosen = [everyone[self.numbers[person]] for person in people]
        if not inferred:
            return chosen
        draws = self.file.draws(self.human, self.draws)
        silent = () if self.plan_anyway else self.unexplained
        found = []
        for person, one in zip(people, chosen, strict=True):
            column = [self.file.people.index(person)]
            own = Person(self.human, {site: value[:, column] for site, value in draws.items()})
            because = NOT_EXPLAINED if person in silent else ""
            found.append(replace(one, person=own, silent_because=because))
        return found

    def play(
        self, people: Sequence[str], name: str, rates: Sequence[dict[str, float]] | None = None
    ) -> list[Played]:
        """Play the rounds of some people with one communicator.

        Args:
            people: their ids.
            name: of the communicator.
            rates: for ``random``, of each of them.
        """
        found = self.listeners(people, name.startswith("mirror"))
        says = [
            speaker(name, one, self.planner, self.seed + self.numbers[person], own)
            for one, person, own in zip(found, people, rates or [None] * len(found), strict=True)
        ]
        return play_together(found, says, self.keep_log)

    def identity(self) -> str:
        """Hash of everything that results depend on."""
        settings = {
            name: value if isinstance(value, (int, str, type(None))) else str(value)
            for name, value in asdict(self).items()
            if name != "posterior"
        }
        digest = hashlib.sha256(json.dumps([settings, __version__], sort_keys=True).encode())
        digest.update(code_of(self.domain).encode())
        weights = self.self_model or shipped_weights(self.domain.name)
        models = map(file_of, (self.human_model, self.people_model))
        for path in (self.posterior, weights, *models):
            digest.update(b"" if path is None else path.read_bytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class Turn:
    """Some people with one communicator, or with several of which one depends on another.

    Attributes:
        people: ids of the people, who play together.
        communicators: by name; ``random`` comes after the communicator whose rates it has.
    """

    people: tuple[str, ...]
    communicators: tuple[str, ...]

    @property
    def label(self) -> str:
        """Name in progress messages."""
        who = ", ".join(self.people)
        return f"{' and '.join(self.communicators)}, {who}"


def turns(communicators: Sequence[str], people: Sequence[str]) -> list[Turn]:
    """List every communicator with every person, slowest first, so that processes end together.

    Args:
        communicators: by name.
        people: ids of the people.
    """
    first: list[tuple[str, ...]] = [
        (name,) for name in communicators if name not in (RATES_FROM, "random")
    ]
    if "random" in communicators:
        first.append((RATES_FROM, "random"))
    elif RATES_FROM in communicators:
        first.append((RATES_FROM,))
    first.sort(key=lambda names: not names[0].startswith(("mirror", "oracle")))
    found = []
    for names in first:
        size = PLANNED_TOGETHER if names[0] in PLANNERS else TOGETHER
        groups = [people[begin : begin + size] for begin in range(0, len(people), size)]
        found += [Turn(tuple(group), names) for group in groups]
    return found


def play_all(pairing: Pairing, chosen: Sequence[Turn], runner: Runner) -> dict[str, list[Played]]:
    """Play all turns, and return each communicator's results.

    Args:
        pairing: description of the pairings.
        chosen: turns that are played.
        runner: does the work and keeps finished results.
    """
    identity = pairing.identity()
    form = JsonFormat(
        lambda content: {name: [Played(**one) for one in own] for name, own in content.items()}
    )
    outcomes = replace(runner, identity=lambda turn: identity).run(
        chosen, partial(_play, pairing), form
    )
    played: dict[str, list[Played]] = {}
    for outcome in outcomes:
        assert outcome.result is not None
        for name, own in outcome.result.items():
            played.setdefault(name, []).extend(own)
    return played


def _play(pairing: Pairing, turn: Turn) -> dict[str, list[Played]]:
    played: dict[str, list[Played]] = {}
    for name in turn.communicators:
        rates = [one.rates() for one in played[RATES_FROM]] if name == "random" else None
        played[name] = pairing.play(turn.people, name, rates)
    return played

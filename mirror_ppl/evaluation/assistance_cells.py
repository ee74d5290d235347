"""The work of pairing people with communicators, in cells that can be done beside each other."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path

from mirror_ppl.communication.person import Person
from mirror_ppl.domains import Domain, get_domain
from mirror_ppl.domains.registry import code_of
from mirror_ppl.errors import PosteriorError
from mirror_ppl.evaluation.assistance import (
    RATES_FROM,
    Listener,
    PlannerOptions,
    listeners,
    play,
    speaker,
)
from mirror_ppl.evaluation.played import Played
from mirror_ppl.inference.results.posterior_file import PosteriorFile, load_posterior
from mirror_ppl.jobs import JsonFormat, Runner
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import file_of, load_human_model
from mirror_ppl.models.weights import fingerprint, load_self_model, shipped_weights
from mirror_ppl.people import simulated_people
from mirror_ppl.people.robot_like import SELF_MODEL
from mirror_ppl.version import __version__


@dataclass(frozen=True)
class Pairing:
    """Who is paired in which rounds; enough for any process to do a cell.

    Attributes:
        posterior: file of the people's posterior.
        human_model, self_model: what it was fitted with; the package's own unless given.
        draws: posterior draws that are planned with.
        setting, population, people_seed, people: who the people are.
        rounds: rounds of each.
        planner: settings of the planners.
        seed: of the rounds and of everything random.
        keep_log: whether to keep every decision.
    """

    posterior: Path
    human_model: str | None
    self_model: Path | None
    draws: int
    setting: str
    population: str
    people_seed: int
    people: int
    rounds: int
    planner: PlannerOptions
    seed: int
    keep_log: bool

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
        return load_human_model(self.human_model, self_model)

    def check(self) -> None:
        """Find out what cannot work before any work is done.

        Raises:
            MirrorError: the posterior, the human model and the self-model do not go together.
        """
        check_contract(self.human)
        self.file.draws(self.human, self.draws)
        simulated = self.file.attributes.get(f"recorded_{SELF_MODEL}")
        if simulated not in (None, fingerprint(self.human.self_model)):
            raise PosteriorError(
                f"{self.posterior}: its people were simulated with another self-model "
                f"({simulated}); simulate and fit them anew with this one"
            )

    def listener(self, number: int, inferred: bool = True) -> Listener:
        """The person of that number, with their rounds, and what was inferred of them."""
        everybody = simulated_people(
            self.domain.name,
            self.setting,
            self.population,
            self.people,
            self.people_seed,
            self_model=self.self_model,
        )
        listener = listeners(everybody, self.people, self.setting, self.rounds, self.seed)[number]
        if not inferred:
            return listener
        own = slice(number, number + 1)
        draws = self.file.draws(self.human, self.draws)
        person = Person(self.human, {site: value[:, own] for site, value in draws.items()})
        return replace(listener, person=person)

    def play(self, number: int, name: str, rates: dict[str, float] | None) -> Played:
        """Rounds of the person of that number with one communicator."""
        listener = self.listener(number, name.startswith("mirror"))
        say = speaker(name, listener, self.planner, self.seed + number, rates)
        return play(listener, say, self.keep_log)

    def identity(self) -> str:
        """What results belong to: a hash of everything that they depend on."""
        settings = {
            name: value if isinstance(value, (int, str, type(None))) else str(value)
            for name, value in asdict(self).items()
            if name != "posterior"
        }
        digest = hashlib.sha256(json.dumps([settings, __version__], sort_keys=True).encode())
        digest.update(code_of(self.domain).encode())
        weights = self.self_model or shipped_weights(self.domain.name)
        for path in (self.posterior, weights, file_of(self.human_model)):
            digest.update(b"" if path is None else path.read_bytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class Turn:
    """One person with one communicator, or with several of which one depends on another.

    Attributes:
        person: their number.
        communicators: by name; ``random`` comes after the one whose rates it has.
    """

    person: int
    communicators: tuple[str, ...]

    @property
    def label(self) -> str:
        """What it is, for people who wait."""
        return f"{' and '.join(self.communicators)}, person {self.person + 1}"


def turns(communicators: Sequence[str], people: int) -> list[Turn]:
    """Every communicator with every person, slowest first, so that processes end together.

    Args:
        communicators: by name.
        people: how many of the people, from the first on.
    """
    first: list[tuple[str, ...]] = [
        (name,) for name in communicators if name not in (RATES_FROM, "random")
    ]
    if "random" in communicators:
        first.append((RATES_FROM, "random"))
    elif RATES_FROM in communicators:
        first.append((RATES_FROM,))
    first.sort(key=lambda names: not names[0].startswith(("mirror", "oracle")))
    return [Turn(number, names) for names in first for number in range(people)]


def play_all(pairing: Pairing, chosen: Sequence[Turn], runner: Runner) -> dict[str, list[Played]]:
    """What each person played with each communicator.

    Args:
        pairing: who is paired in which rounds.
        chosen: everything that is played.
        runner: does the work and keeps what is finished.
    """
    identity = pairing.identity()
    form = JsonFormat(lambda content: {name: Played(**one) for name, one in content.items()})
    outcomes = replace(runner, identity=lambda turn: identity).run(
        chosen, partial(_play, pairing), form
    )
    played: dict[str, list[Played]] = {}
    for outcome in outcomes:
        assert outcome.result is not None
        for name, own in outcome.result.items():
            played.setdefault(name, []).append(own)
    return played


def _play(pairing: Pairing, turn: Turn) -> dict[str, Played]:
    played: dict[str, Played] = {}
    for name in turn.communicators:
        rates = played[RATES_FROM].rates() if name == "random" else None
        played[name] = pairing.play(turn.person, name, rates)
    return played

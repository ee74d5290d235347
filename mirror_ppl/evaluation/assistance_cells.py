"""Pairings of people with communicators, as cells that can run in parallel."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import torch

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
from mirror_ppl.inference.results.posterior_file import PosteriorFile, load_posterior
from mirror_ppl.jobs import JsonFormat, Runner
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import file_of, load_human_model
from mirror_ppl.models.weights import fingerprint, load_self_model, shipped_weights
from mirror_ppl.people import simulated_people
from mirror_ppl.people.robot_like import SELF_MODEL
from mirror_ppl.version import __version__

TOGETHER, PLANNED_TOGETHER = 5, 2
"""People who play together, and with planners: a step of many takes hardly longer than one of few,
but planners decide one after the other, and fewer together let more processes work at once."""


@dataclass(frozen=True)
class Pairing:
    """Description of pairings and rounds, from which any process can run a cell.

    Attributes:
        posterior: file of the people's posterior.
        human_model, self_model: those of the fit; the package's own unless given.
        draws: posterior draws to plan with.
        setting, population, people_seed, people: arguments that simulate the people.
        rounds: number of rounds of each person.
        planner: settings of the planners.
        seed: of the rounds and of everything random.
        keep_log: True to keep every decision.
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

    def listeners(self, numbers: Sequence[int], inferred: bool = True) -> list[Listener]:
        """Return people by number, with their rounds and their posteriors."""
        everybody = simulated_people(
            self.domain.name,
            self.setting,
            self.population,
            self.people,
            self.people_seed,
            self_model=self.self_model,
        )
        found = listeners(everybody, self.people, self.setting, self.rounds, self.seed)
        chosen = [found[number] for number in numbers]
        if not inferred:
            return chosen
        draws = self.file.draws(self.human, self.draws)
        return [
            replace(one, person=Person(self.human, {site: v[:, [n]] for site, v in draws.items()}))
            for n, one in zip(numbers, chosen, strict=True)
        ]

    def play(
        self, numbers: Sequence[int], name: str, rates: Sequence[dict[str, float]] | None = None
    ) -> list[Played]:
        """Play the rounds of some people, by number, with one communicator.

        Args:
            numbers: of the people.
            name: of the communicator.
            rates: for ``random``, of each of them.
        """
        people = self.listeners(numbers, name.startswith("mirror"))
        says = [
            speaker(name, one, self.planner, self.seed + number, own)
            for one, number, own in zip(people, numbers, rates or [None] * len(people), strict=True)
        ]
        return play_together(people, says, self.keep_log)

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
        for path in (self.posterior, weights, file_of(self.human_model)):
            digest.update(b"" if path is None else path.read_bytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class Turn:
    """Some people with one communicator, or with several of which one depends on another.

    Attributes:
        people: numbers of the people, who play together.
        communicators: by name; ``random`` comes after the communicator whose rates it has.
    """

    people: tuple[int, ...]
    communicators: tuple[str, ...]

    @property
    def label(self) -> str:
        """Name in progress messages."""
        first, last = self.people[0] + 1, self.people[-1] + 1
        who = f"person {first}" if first == last else f"people {first} to {last}"
        return f"{' and '.join(self.communicators)}, {who}"


def turns(communicators: Sequence[str], people: int) -> list[Turn]:
    """List every communicator with every person, slowest first, so that processes end together.

    Args:
        communicators: by name.
        people: number of people, from the first on.
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
        groups = torch.arange(people).split(size)
        found += [Turn(tuple(group.tolist()), names) for group in groups]
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

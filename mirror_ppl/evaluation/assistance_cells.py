"""The work of pairing people with communicators, in cells that run beside each other and resume.

A cell is one person with one communicator; the results of each are a file of its own until the
whole is done.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from mirror_ppl import __version__
from mirror_ppl.communication.person import Person
from mirror_ppl.domains import Domain, get_domain
from mirror_ppl.evaluation.assistance import (
    COMMUNICATORS,
    RATES_FROM,
    Listener,
    PlannerOptions,
    Played,
    listeners,
    play,
    speaker,
)
from mirror_ppl.files import write_whole
from mirror_ppl.inference.results.posterior_file import PosteriorFile, load_posterior
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import file_of, load_human_model
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.workers import run_tasks


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

    def listener(self, number: int, inferred: bool = True) -> Listener:
        """The person of that number, with their rounds, and what was inferred of them."""
        listener = listeners(
            self.domain,
            self.setting,
            self.population,
            self.people,
            self.people_seed,
            self.rounds,
            self.seed,
        )[number]
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
        for path in (self.posterior, self.self_model, file_of(self.human_model)):
            digest.update(b"" if path is None else path.read_bytes())
        return digest.hexdigest()

    def forget(self, parts: Path) -> None:
        """Remove the files of finished cells, and their folder if nothing else is in it."""
        for name in COMMUNICATORS:
            for number in range(self.people):
                (parts / f"{name}-{number}.json").unlink(missing_ok=True)
        with suppress(OSError):
            parts.rmdir()


def run_cells(
    pairing: Pairing,
    communicators: Sequence[str],
    people: int,
    jobs: int,
    parts: Path | None,
    report: Callable[[int, str], None] = lambda done, message: None,
) -> dict[str, list[Played]]:
    """Play every cell.

    Args:
        pairing: who is paired in which rounds.
        communicators: by name.
        people: how many of the people, from the first on.
        jobs: processes.
        parts: folder in which finished cells are kept, and looked for.
        report: told how many cells are done, and which was the last.

    Returns:
        Of each communicator, what each person played.
    """
    # Slowest first, so that no process is left waiting for another at the end.
    first = [name for name in communicators if name != "random"]
    first.sort(key=lambda name: not name.startswith(("mirror", "oracle")))
    if "random" in communicators and RATES_FROM not in first:
        first.insert(0, RATES_FROM)
    identity = pairing.identity() if parts is not None else ""
    results: dict[tuple[str, int], Played] = {}

    def work(names: Sequence[str]) -> None:
        rates: dict[int, dict[str, float] | None] = {
            number: results[RATES_FROM, number].rates() if "random" in names else None
            for number in range(people)
        }
        tasks = [
            partial(_cell, pairing, name, number, rates[number], parts, identity)
            for name in names
            for number in range(people)
        ]
        for name, number, played in run_tasks(tasks, jobs):
            results[name, number] = played
            report(len(results), f"{name}, person {number + 1}")

    work(first)
    if "random" in communicators:
        work(["random"])
    return {name: [results[name, number] for number in range(people)] for name in communicators}


def _cell(
    pairing: Pairing,
    name: str,
    number: int,
    rates: dict[str, float] | None,
    parts: Path | None,
    identity: str,
) -> tuple[str, int, Played]:
    path = None if parts is None else parts / f"{name}-{number}.json"
    played = None if path is None else _kept(path, identity)
    if played is None:
        played = pairing.play(number, name, rates)
        if path is not None:
            write_whole(path, json.dumps({"identity": identity, "played": asdict(played)}))
    return name, number, played


def _kept(path: Path, identity: str) -> Played | None:
    """What an earlier run left, if it was a run of the same thing."""
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        return Played(**content["played"]) if content["identity"] == identity else None
    except (OSError, ValueError, KeyError, TypeError):
        return None

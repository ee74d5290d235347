"""`python -m mirror_ppl.assist`: pair communicators with people, and compare net returns."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mirror_ppl.errors import (
    OptionError,
    PosteriorError,
    UnknownNameError,
)
from mirror_ppl.limits import check_numbers, check_picture
from mirror_ppl.progress import Progress

if TYPE_CHECKING:
    from mirror_ppl.evaluation.assistance_cells import Pairing
    from mirror_ppl.evaluation.played import Played
    from mirror_ppl.inference.results.posterior_file import PosteriorFile

KL, LEARNED = "mirror-kl", "mirror-self-model"
PROGRAM = "python -m mirror_ppl.assist"
DIGITS = 9
"""Digits of a number of people that are read; more are too many people anyway."""
DESCRIPTION = """Let communicators send messages to the simulated people of a posterior in their
rounds, and print for each the people's returns, the cost of messages and what they were about. All
play the same rounds with the same random numbers. With --json, --log or --film, the same
command resumes a stopped run."""
EXAMPLES = {
    "all communicators, with every decision in a file": (
        "--json runs/assist.json --log runs/assist.jsonl"
    ),
    "the round that messages changed most, as a filmstrip": (
        "--communicator mirror none --film runs/film.png"
    ),
}
"""Arguments, by what they are for."""


@dataclass(frozen=True)
class Options:
    """Whom to help, how, and where the results go."""

    posterior: Path = Path("runs/demo/posterior.nc")
    """A posterior of simulated people, or the folder of their fit (of make demo unless given)."""
    domain: str | None = None
    """The world that the posterior has to be of; that of the posterior unless given. One of your
    own has to be: path/to/file.py:Class, whose code is run."""
    setting: str | None = None
    """The setting that the posterior has to be of; that of the posterior unless given."""
    communicator: tuple[str, ...] = ()
    """One or several of mirror, mirror-self-model, mirror-kl, none, all, random, nearest, oracle;
    all of them unless given (but for mirror-self-model where the robot was taught wrong rules).
    They are described in docs/communicator.md."""
    rounds: int = 20
    """Rounds of each person."""
    people: tuple[str, ...] = ()
    """Ids of the people to assist, or how many of them, from the first on; all unless given."""
    draws: int = 64
    """Posterior draws that are planned with."""
    horizon: int | None = None
    """Steps that planners look ahead; 10 in driving, 16 in search_rescue and 24 in bomb_defusal
    unless given. In highway mirror values the next action alone, without looking ahead."""
    discount: float | None = None
    """Worth of a reward one step later, from above 0 to 1; 1 unless given."""
    min_standard_errors: float | None = None
    """How many standard errors of its gain a message has to gain to be sent; 0 is enough for the
    best on average. 2 in highway, 1 in driving and search_rescue and 0 in bomb_defusal unless
    given."""
    patience: int | None = None
    """Steps over which a message is compared with saying it later; 1 compares with silence only."""
    enumerate_above: float | None = None
    """Action sequences at least this probable are enumerated, others sampled: 0 is exact, 1 samples
    one sequence a draw; 0.1 in driving and 0.4 in search_rescue and bomb_defusal unless given."""
    hears: float | None = None
    """Prior probability that messages of a channel reach a person; updated by what they do after
    messages. 1 assumes that all messages reach them; 0.9 unless given."""
    plan_anyway: bool = False
    """Plan messages for people whose actions the human model does not explain (verdict
    unexplained), too; else they get none from mirror, mirror-self-model and mirror-kl, nor from
    random, which has the rates of mirror."""
    kl_weight: float | None = None
    """Units of reward that mirror-kl gives for a nat; 1 unless given."""
    kl_measure: str | None = None
    """What mirror-kl measures: kl (unless given), or squared (the distance of means of the
    released code)."""
    json: Path | None = None
    """Write the results as data; the folder is made if it is not there."""
    log: Path | None = None
    """Write every decision with its audit, one JSON object a line, over what is there."""
    film: Path | None = None
    """Draw a filmstrip (png, pdf or svg) of the round in which messages gained most: without
    messages, if none is among the communicators, and with the first other one."""
    human_model: str | None = None
    """The human model that the posterior is of, if it is one of your own: path/to/file.py:Class,
    whose code is run."""
    people_model: str | None = None
    """The human model that the people were simulated with, if it is one of your own:
    path/to/file.py:Class, whose code is run; as it was then."""
    self_model: Path | None = None
    """Weights of the robot's self-model; those that ship unless given."""
    population: str | None = None
    """Who the people are, where the posterior does not say: paper, diverse, or the prior of a human
    model of the package, such as "prior of Late"."""
    people_seed: int | None = None
    """The seed that the people were simulated with, where the posterior does not say."""
    seed: int = 0
    """Seed of the rounds and of everything random."""
    jobs: int = 2
    """Processes that share the work."""
    scheduler: str | None = None
    """Address of a Dask cluster that does the work instead, such as tcp://host:8786."""

    def __post_init__(self) -> None:
        check_numbers(self, "rounds", "draws", "horizon", "patience", jobs=1)
        check_numbers(self, "seed", "people_seed")
        if self.discount is not None and not 0 < self.discount <= 1:
            raise OptionError(f"--discount must be above 0 and at most 1, not {self.discount}")
        if self.enumerate_above is not None and not 0 <= self.enumerate_above <= 1:
            raise OptionError(f"--enumerate-above must be from 0 to 1, not {self.enumerate_above}")
        if self.min_standard_errors is not None and not self.min_standard_errors >= 0:
            raise OptionError(
                f"--min-standard-errors must be at least 0, not {self.min_standard_errors}"
            )
        if self.hears is not None and not 0 < self.hears <= 1:
            raise OptionError(f"--hears must be above 0 and at most 1, not {self.hears}")
        if self.kl_weight is not None and not 0 < self.kl_weight < math.inf:
            raise OptionError(f"--kl-weight must be a positive number, not {self.kl_weight}")
        check_picture(self.film, "--film")
        if self.kl_measure not in (None, "kl", "squared"):
            raise OptionError(f'--kl-measure must be kl or squared, not "{self.kl_measure}"')


def main(options: Options) -> None:
    """Pair, write the results, and print what was found.

    Raises:
        MirrorError: what was asked for cannot be done; nothing is written then.
    """
    from mirror_ppl.evaluation.assistance import COMMUNICATORS
    from mirror_ppl.evaluation.assistance_cells import play_all, turns
    from mirror_ppl.evaluation.assistance_report import print_assistance
    from mirror_ppl.evaluation.assistance_summary import summarize_assistance
    from mirror_ppl.files import lock_of, output_folder, write_together
    from mirror_ppl.inference.results.posterior_file import posterior_at
    from mirror_ppl.jobs import Runner

    options = replace(options, posterior=posterior_at(options.posterior))
    chosen = options.communicator or COMMUNICATORS
    for name in chosen:
        if name not in COMMUNICATORS:
            raise UnknownNameError.of("communicator", name, COMMUNICATORS)
    chosen = tuple(name for name in COMMUNICATORS if name in chosen)
    if options.film is not None:
        from mirror_ppl.evaluation.film import compared

        compared(chosen)
    outputs = _outputs(options)
    kept = options.json or options.log or options.film
    posterior, source = _people(options)
    people = _chosen(options, posterior.people)
    pairing = _pairing(options, posterior, source, people)
    pairing.check()
    chosen = _possible(options, chosen, pairing)
    _warn_of_unused(options, chosen, pairing.planner.predict_with)
    _warn_of_unexplained_people(pairing, chosen)
    parts = None if kept is None else kept.with_name(f".{kept.name}.parts")
    cells = turns(chosen, people)
    with ExitStack() as stack:
        for path in outputs:
            own = [parts.name] if parts is not None and path == kept else []
            results = output_folder(path.parent, [path.name], lock_of(path), own)
            stack.enter_context(results)
        progress = stack.enter_context(Progress("assist", len(cells)))
        runner = Runner(parts, jobs=options.jobs, scheduler=options.scheduler, progress=progress)
        everything = play_all(pairing, cells, runner)
        played = {name: everything[name] for name in chosen}
        summary = summarize_assistance(played, options.seed)
        write_together(_contents(options, posterior, pairing, played, summary))
        runner.clean()
    print_assistance(summary, posterior.attributes, len(people), options.rounds)
    for path, what in (
        (options.json, "the numbers above"),
        (options.log, "every decision"),
        (options.film, "a filmstrip"),
    ):
        if path is not None:
            print(f"{path}: {what}")


def _chosen(options: Options, known: Sequence[str]) -> tuple[str, ...]:
    """Ids of the people to assist, in the order of the posterior."""
    from mirror_ppl.domains import require_known

    given = options.people
    if len(given) == 1 and given[0] not in known and given[0].isdecimal():
        number = int(given[0][:DIGITS])
        if number < 1:
            raise OptionError(f"--people must be at least 1, not {number}")
        if number > len(known):
            raise PosteriorError(f"{options.posterior}: is of {len(known)} people, not {given[0]}")
        return tuple(known[:number])
    for person in given:
        require_known(person, "person", known)
    return tuple(person for person in known if person in given) if given else tuple(known)


def _pairing(
    options: Options,
    posterior: PosteriorFile,
    source: Mapping[str, Any],
    people: tuple[str, ...],
) -> Pairing:
    """Who is paired in which rounds."""
    from mirror_ppl.evaluation.assistance import PlannerOptions
    from mirror_ppl.evaluation.assistance_cells import Pairing

    planner = PlannerOptions.of(
        posterior.attributes["domain"],
        horizon=options.horizon,
        discount=options.discount,
        enumerate_above=options.enumerate_above,
        patience=options.patience,
        min_standard_errors=options.min_standard_errors,
        hears=options.hears,
        kl_weight=options.kl_weight,
        kl_measure=options.kl_measure,
    )
    return Pairing(
        posterior=options.posterior,
        human_model=options.human_model,
        self_model=options.self_model,
        draws=options.draws,
        setting=posterior.attributes["setting"],
        population=source["population"],
        people_seed=int(source["seed"]),
        people_model=options.people_model,
        people=people,
        rounds=options.rounds,
        planner=planner,
        seed=options.seed,
        keep_log=options.log is not None or options.film is not None,
        plan_anyway=options.plan_anyway,
    )


def _warn_of_unexplained_people(pairing: Pairing, chosen: Sequence[str]) -> None:
    """Print who of the people is not explained by the human model, if planners are chosen."""
    from mirror_ppl.communication.planners import PLANNERS
    from mirror_ppl.inference.results.criticism import warning_of

    planning = not {*PLANNERS, "random"}.isdisjoint(chosen)
    if planning and (some := pairing.unexplained):
        print(warning_of(some, "--plan-anyway", pairing.plan_anyway), file=sys.stderr)


def _possible(options: Options, chosen: tuple[str, ...], pairing: Pairing) -> tuple[str, ...]:
    """Communicators without those that cannot plan for these people, unless they are asked for."""
    from mirror_ppl.communication.objectives import beliefs_have_density, require_density
    from mirror_ppl.evaluation.assistance import NO_ORACLE
    from mirror_ppl.people import has_oracle

    if KL in chosen and not beliefs_have_density(pairing.human):
        if KL in options.communicator:
            require_density(pairing.human)
        chosen = tuple(name for name in chosen if name != KL)
        name = type(pairing.human).__name__
        print(f"{KL} is left out: beliefs of {name} have no density", file=sys.stderr)
    if not (options.communicator or has_oracle(pairing.domain.name, pairing.population)):
        chosen = tuple(name for name in chosen if name != "oracle")
        print(f"oracle is left out: {NO_ORACLE}", file=sys.stderr)
    if not options.communicator and pairing.domain.as_believed is not pairing.domain:
        chosen = tuple(name for name in chosen if name != LEARNED)
        print(
            f"{LEARNED} is left out: the robot was taught wrong in {pairing.domain.name}",
            file=sys.stderr,
        )
    return chosen


def _warn_of_unused(options: Options, chosen: Sequence[str], predict_with: str) -> None:
    """Print which options no chosen communicator uses; the oracle may be a planner."""
    ahead = {LEARNED, "oracle"} | ({"mirror", "random"} if predict_with != "values" else set())
    uses = {
        "horizon": ahead,
        "discount": ahead,
        "patience": ahead,
        "enumerate_above": ahead,
        "kl_weight": {KL},
        "kl_measure": {KL},
    }
    for name, users in uses.items():
        if getattr(options, name) is not None and users.isdisjoint(chosen):
            option = f"--{name.replace('_', '-')}"
            print(f"warning: {option} has no effect on {', '.join(chosen)}", file=sys.stderr)


def _contents(
    options: Options,
    posterior: PosteriorFile,
    pairing: Pairing,
    played: Mapping[str, Sequence[Played]],
    summary: dict[str, dict[str, Any]],
) -> dict[Path, str | bytes]:
    """What is written: a summary as data, every decision, and a filmstrip."""
    from mirror_ppl.evaluation.assistance_summary import compare
    from mirror_ppl.files import json_text, plain

    contents: dict[Path, str | bytes] = {}
    if options.json is not None:
        results: dict[str, Any] = {
            "command": PROGRAM,
            "options": {
                name: value
                for name, value in asdict(options).items()
                if name not in ("json", "log", "film", "jobs", "scheduler")
            },
            "posterior": dict(posterior.attributes),
            "unexplained": list(pairing.unexplained),
            "communicators": summary,
        }
        if "mirror" in played:
            results["mirror_above"] = {
                name: compare(played, "mirror", name, options.seed)
                for name in played
                if name != "mirror"
            }
        contents[options.json] = json_text(results)
    if options.log is not None:
        lines = [
            json.dumps(plain({"communicator": name, "person": pairing.people[person]} | entry))
            + "\n"
            for name, people in played.items()
            for person, one in enumerate(people)
            for entry in one.log
        ]
        contents[options.log] = "".join(lines)
    if options.film is not None:
        from mirror_ppl.evaluation.film import film
        from mirror_ppl.plots.film import plot_film

        shown = film(pairing, played, options.communicator)
        kind = options.film.suffix[1:].lower()
        contents[options.film] = plot_film(shown, pairing.people).content(kind)
    return contents


def _outputs(options: Options) -> list[Path]:
    from mirror_ppl.files import require_files_of_their_own
    from mirror_ppl.models.loading import file_of

    inputs = {
        "--posterior": [options.posterior],
        "--self-model": [options.self_model],
        "--human-model": [file_of(options.human_model)],
        "--people-model": [file_of(options.people_model)],
    }
    return require_files_of_their_own(
        {"--json": options.json, "--log": options.log, "--film": options.film}, inputs
    )


def _people(options: Options):
    """The posterior, and what its people were simulated with."""
    from mirror_ppl.domains import get_domain, require_known
    from mirror_ppl.inference.results.posterior_file import load_posterior
    from mirror_ppl.models.simulation import OWN_HUMAN_MODEL, PRIOR_OF
    from mirror_ppl.people import populations_of

    given = None if options.domain is None else get_domain(options.domain).name
    posterior = load_posterior(options.posterior, given)
    domain = posterior.attributes["domain"]
    settings = get_domain(domain).settings
    if options.setting is not None:
        require_known(options.setting, "setting", settings, domain)
    own = posterior.attributes.get("setting", "unknown")
    if options.setting not in (None, own):
        raise PosteriorError(
            f"{options.posterior}: is of people in the setting {own}, not {options.setting}"
        )
    require_known(own, "setting", settings, domain)
    source: dict[str, Any] = {
        "population": posterior.attributes.get("recorded_population", options.population),
        "seed": posterior.attributes.get("recorded_seed", options.people_seed),
    }
    for option, name, given in (
        ("--population", "population", options.population),
        ("--people-seed", "seed", options.people_seed),
    ):
        if given is not None and str(given) != str(source[name]):
            raise PosteriorError(
                f"{options.posterior}: is of people with {name} {source[name]}, not {given} "
                f"({option})"
            )
    if None in source.values():
        raise PosteriorError(
            f"{options.posterior}: is not of simulated people, as far as it says; recorded people "
            "are assisted from Python (docs/communicator.md), and only if these are simulated "
            "people, give --population and --people-seed"
        )
    if not str(source["seed"]).isdecimal():
        raise PosteriorError(f"{options.posterior}: its people's seed is {source['seed']}")
    if not str(source["population"]).startswith(PRIOR_OF):
        require_known(source["population"], "population", populations_of(domain))
        if options.people_model is not None:
            raise OptionError(
                f"--people-model is for people of your own human model; those of "
                f"{options.posterior} are of the population {source['population']}"
            )
    elif f"recorded_{OWN_HUMAN_MODEL}" in posterior.attributes and options.people_model is None:
        own = OWN_HUMAN_MODEL in posterior.attributes and options.human_model is None
        also = ", and the model that was fitted by --human-model" if own else ""
        raise PosteriorError(
            f"{options.posterior}: is of people drawn from the {source['population']}, your own "
            "human model; give it by --people-model path/to/file.py:Class" + also
        )
    return posterior, source

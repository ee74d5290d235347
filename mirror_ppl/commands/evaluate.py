"""`python -m mirror_ppl.evaluate`: the paper's comparisons, one command each."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from mirror_ppl.errors import OptionError, UnknownNameError
from mirror_ppl.limits import check_numbers
from mirror_ppl.progress import Progress

if TYPE_CHECKING:
    from mirror_ppl.jobs import Outcome

PROGRAM = "python -m mirror_ppl.evaluate"
DESCRIPTION = """Compare MIRROR with its ablations and baselines on simulated people. prediction:
how well each predicts held-out actions, by the number of rounds that it learned from. assistance:
the net return of people who receive messages from communicators that plan with each. relevance: the
share of the communicated items that is relevant. Writes rows of every person (CSV), tables to read
(Markdown), a summary (JSON) and a figure. The same command resumes a stopped run. The exit
status is 1 if something failed."""
EXAMPLES = {
    "a quick look at predictions beside baselines": (
        "prediction --people 4 --seeds 1 --models mirror bc logistic --out runs/baselines"
    ),
    "what messages are worth in another world": (
        "assistance --domain search_rescue --out runs/rescue"
    ),
}
"""Arguments, by what they are for."""
FAILED = 1
QUICK = ("driving",)
"""Worlds of short rounds, of which more is learned in the same time."""
SEEDS, FEW_SEEDS = (5, 2), (2, 1)
"""Default numbers of seeds in those worlds and in others: for prediction, other studies."""
ROUNDS, OTHER_ROUNDS = {"prediction": (1, 2, 5, 10, 20)}, (0, 1, 5, 20)
"""Numbers of rounds that are learned from unless they are asked for."""
TOLD = 0.03
"""Probability that an item is communicated at a step, in rounds that models learn from."""


@dataclass(frozen=True)
class Options:
    """What to compare, in whom, and where the results go."""

    study: Positional[Literal["prediction", "assistance", "relevance"]]
    """What is compared."""
    domain: tuple[str, ...] = ("driving",)
    """One or several worlds: driving, search_rescue, bomb_defusal, highway, or of your own,
    path/to/file.py:Class, whose code is run."""
    setting: tuple[str, ...] = ()
    """Settings: by default all of prediction, and the one in which people see least otherwise."""
    population: str = "paper"
    """Which simulated people: paper or diverse."""
    people: int = 10
    """People of each seed."""
    seeds: int | None = None
    """Seeds 0, 1 and so on, of people and rounds. Unless given 5 of prediction and 2 of the others
    in driving, and 2 and 1 where rounds are long: on two cores all studies of a world then take
    about an hour."""
    models: tuple[str, ...] = ()
    """What is compared; by default everything that fits the study: mirror, mirror-pooled,
    mirror-population, mirror-amortized, mirror-svi, perceptual-only, policy-only, no-implants,
    bc, bc-everything, bc-pooled, sqil, sqil-everything, sqil-pooled, logistic, base-rate (and, if
    asked for, mirror-nuts, mirror-known-sight, bc-informed, bc-informed-pooled, sqil-informed), or
    of assistance and relevance mirror (which also plans as mirror-kl), perceptual-only,
    policy-only, no-implants, bc, bc-informed, sqil, none, all, nearest, oracle (and, if asked for,
    mirror-pooled, mirror-population, mirror-known-sight, bc-pooled, bc-informed-pooled,
    sqil-informed, sqil-pooled). path/to/file.py:Class is a human model of your own, whose code is
    run."""
    rounds: tuple[int, ...] = ()
    """Numbers of rounds that are learned from, up to 20; the most only, for relevance. 0, of models
    with a prior, is of assistance and relevance. Unless given 1, 2, 5, 10 and 20 of prediction, and
    0, 1, 5 and 20 otherwise."""
    played: int = 5
    """Rounds of each person in which they receive messages; of assistance and relevance."""
    draws: int = 64
    """Posterior draws that are planned with; of assistance and relevance."""
    told: float | None = None
    """Probability that an item that can be communicated is, at each step of the rounds that models
    learn from. Unless given .03 of assistance and relevance, so that all models can learn how
    people use messages, and 0 of prediction."""
    out: Path = Path("runs/evaluate")
    """Folder for the results; made if it is not there. Tables are of the last command: what is to
    be in one table is asked for at once, and what was done before is not done again."""
    jobs: int = -1
    """Processes on this machine; -1 for one a core."""
    scheduler: str | None = None
    """Address of a Dask cluster that does the work instead, such as tcp://host:8786."""

    def __post_init__(self) -> None:
        check_numbers(self, "people", "seeds", "played", "draws", "jobs")
        if self.study == "prediction":
            for name in ("played", "draws"):
                if getattr(self, name) != getattr(Options, name):  # which has the default
                    raise OptionError(f"--{name} is of assistance and relevance, not of prediction")
        if self.told is not None and not 0 <= self.told <= 1:
            raise OptionError(f"--told must be from 0 to 1, not {self.told}")
        if not self.domain:
            raise OptionError("--domain needs at least one world")
        least = 1 if self.study == "prediction" else 0
        wrong = [number for number in self.rounds if not least <= number <= 20]  # noqa: PLR2004
        if wrong:
            raise OptionError(
                f"--rounds must be from {least} to 20, not {', '.join(map(str, wrong))}"
            )


def main(options: Options) -> int:
    """Compare, write the results, print what was found.

    Returns:
        The exit status: 1 if a part failed.

    Raises:
        MirrorError: what was asked for cannot be done; no results are written then.
    """
    from mirror_ppl.evaluation.study import assist, identities, predict
    from mirror_ppl.evaluation.study_report import REPORTS
    from mirror_ppl.evaluation.tables import comma_separated, page
    from mirror_ppl.files import json_text, output_folder, write_together
    from mirror_ppl.jobs import Runner

    cells = _cells(options)
    work = predict if options.study == "prediction" else assist
    path = options.out / f"{options.study}.csv"
    kinds = (".csv", ".md", ".json", ".png")
    names = [path.with_suffix(kind).name for kind in kinds]
    results = output_folder(path.parent, names, parts=["parts"])
    with results as folder, Progress(options.study, len(cells)) as progress:
        runner = Runner(
            folder / "parts",
            identities(cell.group.domain for cell in cells),
            options.jobs,
            options.scheduler,
            keep_going=True,
            progress=progress,
        )
        outcomes = runner.run(cells, work)
        rows = [row for outcome in outcomes for row in outcome.result or ()]
        failed = [outcome for outcome in outcomes if outcome.error is not None]
        report = REPORTS[options.study](rows) if rows else None
        if report is not None:
            content = _origin(options) | report.data | _effort(outcomes)
            write_together(
                {
                    path: comma_separated(rows),
                    path.with_suffix(".md"): page(report.sentences, report.tables),
                    path.with_suffix(".json"): json_text(content),
                    path.with_suffix(".png"): report.picture.content(),
                }
            )
    if report is not None:
        report.show()
        print(f"{path}: a row for each person, model and number of rounds")
        print(f"{path.with_suffix('.md')}: the tables above")
        print(f"{path.with_suffix('.json')}: means, differences and intervals")
        print(f"{path.with_suffix('.png')}: the same as a picture")
    for outcome in failed:
        print(f"failed: {outcome.cell.label}: {outcome.error}")
    return FAILED if failed else 0


def _told(options: Options) -> float:
    """How much is communicated in the rounds that models learn from."""
    if options.told is not None:
        return options.told
    return 0.0 if options.study == "prediction" else TOLD


def _rounds(options: Options) -> tuple[int, ...]:
    """Numbers of rounds that are learned from."""
    return options.rounds or ROUNDS.get(options.study, OTHER_ROUNDS)


def _cells(options: Options) -> list[Any]:
    """What is to be done."""
    from mirror_ppl.domains import get_domain
    from mirror_ppl.evaluation.learners import Group
    from mirror_ppl.evaluation.study import assistance_cells, prediction_cells
    from mirror_ppl.people import populations_of

    worlds = [get_domain(name) for name in options.domain]
    domains = {world.name: world.settings for world in worlds}
    if len({id(world) for world in worlds}) > len(domains):
        raise OptionError("--domain: two worlds have the same name; give one another name")
    every = sorted({setting for settings in domains.values() for setting in settings})
    for name in options.setting:
        if name not in every:
            raise UnknownNameError.of("setting", name, every)
    predicting = options.study == "prediction"
    told, rounds = _told(options), _rounds(options)
    cells: list[Any] = []
    for domain, settings in domains.items():
        if options.population not in (known := populations_of(domain)):
            raise UnknownNameError.of("population", options.population, known)
        usual = settings if predicting else settings[-1:]
        own = [name for name in options.setting if name in settings] if options.setting else usual
        if not own:
            raise OptionError(
                f"--setting: {domain} has none of {', '.join(options.setting)}; it has "
                f"{', '.join(settings)}"
            )
        for setting in dict.fromkeys(own):
            most = (SEEDS if domain in QUICK else FEW_SEEDS)[0 if predicting else 1]
            for seed in range(options.seeds or most):
                group = Group(domain, setting, options.population, options.people, seed, told)
                cells += (
                    prediction_cells(group, options.models, rounds)
                    if predicting
                    else assistance_cells(
                        group,
                        options.models,
                        rounds if options.study == "assistance" else (max(rounds),),
                        options.played,
                        options.draws,
                    )
                )
    return cells


def _origin(options: Options) -> dict[str, Any]:
    """What was asked for, of which version, and on what machine."""
    import os
    import platform

    import torch

    from mirror_ppl.version import __version__

    return {
        "command": _command(options),
        "options": {name: value for name, value in asdict(options).items() if name != "jobs"}
        | {"told": _told(options), "rounds": list(_rounds(options))},
        "version": __version__,
        "torch": torch.__version__,
        "machine": {"processor": platform.machine(), "cores": os.cpu_count()},
    }


def _command(options: Options) -> str:
    """The command that asks for the same."""
    words = [*PROGRAM.split(), options.study]
    for part in fields(options):
        value = getattr(options, part.name)
        if part.name not in ("study", "jobs") and value != part.default:
            words += [f"--{part.name}", *map(str, value if isinstance(value, tuple) else [value])]
    return shlex.join(words)


def _effort(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Time that each part took, and what failed."""
    return {
        "seconds": {outcome.cell.label: round(outcome.seconds, 1) for outcome in outcomes},
        "failed": {
            outcome.cell.label: outcome.error for outcome in outcomes if outcome.error is not None
        },
    }

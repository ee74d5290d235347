"""`python -m mirror_ppl.calibrate`: simulation-based calibration of an engine's posteriors."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from mirror_ppl.console import console_for_tables
from mirror_ppl.errors import OptionError
from mirror_ppl.inference.names import told_engine
from mirror_ppl.limits import check_numbers
from mirror_ppl.models.prior import sites_of_several_numbers
from mirror_ppl.models.world_knowledge import fit_shipped_world
from mirror_ppl.progress import Progress

if TYPE_CHECKING:
    from mirror_ppl.data import Demonstrations
    from mirror_ppl.inference.amortized_guide import AmortizedGuide
    from mirror_ppl.inference.calibration.ranks import Calibration
    from mirror_ppl.inference.engines import InferenceOptions, Inferred
    from mirror_ppl.models.human import HumanModel

PROGRAM = "python -m mirror_ppl.calibrate"
DESCRIPTION = """Simulation-based calibration: simulates people from the human model's prior, fits
them, and tests that ranks of the truth among posterior draws are uniform. Prints a table for each
implant and number of rounds, and writes ranks.png, ecdf.png, coverage.png and calibration.nc. The
exit status is 1 if calibration is rejected. The same command resumes a stopped run."""
EXAMPLES = {
    "the engine importance, in a few minutes": "--people 100 --rounds 1 5 --out runs/calibration",
    "people who react late": "--human-model late",
}
"""Arguments, by what they are for."""
REJECTED = 1
WIDTH = 80
FEW_PEOPLE = 100
"""Number of people below which tests of uniformity have little power."""


@dataclass(frozen=True)
class Options:
    """What to calibrate, and where the results go."""

    domain: str = "driving"
    """The world: driving, search_rescue, bomb_defusal, highway, or one of your own,
    path/to/file.py:Class, whose code is run."""
    setting: str | None = None
    """The setting under which rounds are recorded; what people see depends on their
    implants. Default: the one in which people see less."""
    guide: str = "importance"
    """What to test: importance, amortized, auto, svi or nuts."""
    guide_file: Path | None = None
    """Network of the guides amortized and auto (see `python -m mirror_ppl.train --what guide`)."""
    people: int = 500
    """People drawn from the prior."""
    rounds: tuple[int, ...] = (1, 5, 20)
    """Numbers of rounds to infer from, increasing."""
    draws: int = 100
    """Posterior draws of each person."""
    out: Path = Path("runs/calibration")
    """Folder for the results; made if it is not there."""
    human_model: str | None = None
    """Another human model: all (averages over several models for each person), late, noticing,
    forgetting, preferring, hard-of-hearing, one-radius, per-item, perceptual-only, policy-only,
    no-implants or (highway) by-angle, or one of your own, path/to/file.py:Class, whose code is run
    (see docs/extending.md)."""
    self_model: Path | None = None
    """Weights of the robot's self-model; those that ship unless given."""
    jobs: int = -1
    """Processes; -1 for one a core."""
    scheduler: str | None = None
    """Address of a Dask cluster that does the work instead, such as tcp://host:8786."""
    seed: int = 0
    """Seed of everything random."""

    def __post_init__(self) -> None:
        check_numbers(self, "people", "draws", "seed")
        if self.guide_file is not None and self.guide not in ("auto", "amortized"):
            raise OptionError("--guide-file is for --guide auto and amortized")
        if not self.rounds or sorted({0, *self.rounds}) != [0, *self.rounds]:
            numbers = " ".join(map(str, self.rounds))
            raise OptionError(f"--rounds must be positive and increase, not {numbers or 'none'}")
        check_numbers(self, "rounds", "jobs")


def main(options: Options) -> int:
    """Calibrate, write the results, print what was found.

    Returns:
        The exit status: 1 if calibration is rejected.

    Raises:
        MirrorError: what was asked for cannot be done; nothing is written then.
    """
    from mirror_ppl.domains import get_domain, require_known
    from mirror_ppl.files import output_folder, write_together
    from mirror_ppl.inference.calibration.study import CalibrationOptions, calibrate
    from mirror_ppl.inference.engines import InferenceOptions, run_identity
    from mirror_ppl.jobs import Runner
    from mirror_ppl.likelihood.contract import check_contract
    from mirror_ppl.models.loading import load_human_model
    from mirror_ppl.models.weights import load_self_model, shipped_weights
    from mirror_ppl.plots.calibration import plot_coverage, plot_ecdf, plot_ranks
    from mirror_ppl.training.guide_file import network_for

    guide = told_engine(options.guide)
    settings = InferenceOptions(guide, options.draws)
    domain = get_domain(options.domain)
    known = domain.settings
    setting = require_known(options.setting or known[-1], "setting", known, domain.name)
    weights = options.self_model or shipped_weights(domain.name)
    self_model, _ = load_self_model(weights, domain.name)
    human = load_human_model(options.human_model, self_model)
    check_contract(human)
    counted, human.likelihood_power = human.likelihood_power, 1.0
    # What is so for everybody is learned first, as by a fit: people are drawn from what is open.
    fit_shipped_world(human, setting)
    network = network_for(guide, options.guide_file, human)
    trial = CalibrationOptions(options.people, options.rounds, batch=5)
    what = [settings, setting, options.seed, trial]
    identity = run_identity(human, network, what)
    pictures = {"ranks.png": plot_ranks, "ecdf.png": plot_ecdf, "coverage.png": plot_coverage}
    results = output_folder(options.out, ["calibration.nc", *pictures], parts=["parts"])
    batches = math.ceil(trial.people / trial.batch)
    with results as folder, Progress("calibrate", batches) as progress:
        runner = Runner(
            folder / "parts",
            lambda batch: identity,
            options.jobs,
            options.scheduler,
            progress=progress,
        )
        tested = partial(_infer, human, settings, network)
        calibration = calibrate(human, tested, trial, setting, options.seed, runner)
        calibration.data.attrs["engine"] = guide
        drawn = {folder / name: plot(calibration).content() for name, plot in pictures.items()}
        write_together({folder / "calibration.nc": calibration.content(), **drawn})
        runner.clean()
    _show(calibration, guide, sites_of_several_numbers(human))
    if counted < 1:
        print(
            f"A decision counts once here and {counted:g} times in fits of this model, whose "
            "intervals are therefore wider than those tested"
        )
    print(f"{folder / 'calibration.nc'}: ranks of every person")
    for path in drawn:
        print(path)
    return REJECTED if calibration.rejected else 0


def _infer(
    human: HumanModel,
    options: InferenceOptions,
    network: AmortizedGuide | None,
    recordings: Demonstrations,
    seed: int,
) -> Inferred:
    from mirror_ppl.inference.engines import infer

    return infer(human, recordings, options, seed, network, checked=True)


def _show(calibration: Calibration, guide: str, several: Collection[str]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(
        title=f"Calibration of {guide}: {calibration.people} people drawn from the prior",
        caption="p: of uniform ranks; 50 to 90%: share of people whose interval holds the truth; "
        "contraction: 0 for the prior, 1 for certainty; k: share of people whose importance "
        "weights are unreliable",
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.add_column("implant", no_wrap=True)
    for name in ("rounds", "p", "50%", "80%", "90%", "contraction", "k"):
        table.add_column(name, justify="right", no_wrap=True)
    rejected = set(calibration.rejected)
    for row in calibration.table().to_dict("records"):
        wrong = (row["site"], row["rounds"]) in rejected
        weights = row["high_pareto_k"]
        table.add_row(
            str(row["site"]).replace("_", " "),
            f"{row['rounds']}",
            f"{row['p_value']:.3f}" + (" rejected" if wrong else ""),
            *(f"{100 * row[f'coverage_{level}']:.1f}" for level in (50, 80, 90)),
            f"{row['contraction']:.2f}",
            "-" if weights != weights else f"{100 * weights:.0f}%",
        )
    console_for_tables(WIDTH).print(table)
    if several:
        print(f"Not tested, as they have several numbers a person: {', '.join(several)}")
    rate = calibration.failure_rate
    verdict = f"rejected for {len(rejected)}" if rejected else "not rejected for any"
    if calibration.people < FEW_PEOPLE:
        print(f"Of {calibration.people} people, only gross faults would show")
    print(f"Calibration is {verdict} of {len(calibration.table())} (a right one: {rate} of each)")

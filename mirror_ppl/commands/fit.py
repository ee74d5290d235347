"""`python -m mirror_ppl.fit`: infer what people see and how they decide."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING

from mirror_ppl.errors import OptionError, PriorConflict, UnreliableWeights
from mirror_ppl.inference.names import told_engine
from mirror_ppl.limits import check_numbers, require_memory, share
from mirror_ppl.progress import Stages

if TYPE_CHECKING:
    from mirror_ppl.data import Demonstrations

PROGRAM = "python -m mirror_ppl.fit"
CHECKPOINT = "fit.checkpoint"
CHECKPOINTS = re.compile(r"fit\.checkpoint(\.\d+)?")
COPIES = 6
"""Number of copies of a person's log-probabilities of actions in each process."""
DESCRIPTION = """Infer from recorded rounds what each person sees and how they decide, with the
uncertainty of it, and measure how well their held-out actions are predicted. Without --demos the
recordings of ten simulated people are used that ship with the package. Writes posterior.nc (ArviZ
InferenceData), summary.json, pictures of what they see, check.png and identifiability.png. The same
command resumes a stopped run."""
EXAMPLES = {
    "ten simulated people who differ in what they see": (
        "--setting fog --population diverse --out runs/diverse"
    ),
    "recordings of your own, five rounds of each person": (
        "--demos runs/people.nc --train-rounds 5 --out runs/people"
    ),
}
"""Arguments, by what they are for."""


@dataclass(frozen=True)
class Options:
    """What to fit, and where the results go."""

    demos: Path | None = None
    """Recordings in the format of docs/demonstrations.md."""
    domain: str | None = None
    """The world of the shipped recordings: driving (unless given), search_rescue,
    bomb_defusal or highway.
    Of --demos of a world of your own, path/to/file.py:Class, whose code is run."""
    setting: str | None = None
    """The setting of the shipped recordings: clear or fog in driving and highway, clear or
    smoke in search_rescue, labelled or unlabelled in bomb_defusal. Default: the one in which
    people see less."""
    population: str | None = None
    """The people of the shipped recordings: paper (unless given; sight limited by the setting
    alone, in bomb_defusal as quick at every terminal) or diverse (each their own sight)."""
    people: tuple[str, ...] = ()
    """Ids of some of the people, whom to fit; all unless given."""
    out: Path = Path("runs/fit")
    """Folder for the results; made if it is not there."""
    train_rounds: int | None = None
    """How many rounds of each person to learn from, from the first on; 0 for none. Default: 20 of
    recordings with 36 rounds or more (rounds 31 to 36 are held out), else three quarters."""
    human_model: str | None = None
    """Another human model: all (averages over several models for each person), late, noticing,
    forgetting, preferring, hard-of-hearing, one-radius, per-item, perceptual-only, policy-only,
    no-implants or (highway) by-angle, or one of your own, path/to/file.py:Class, whose code is run
    (see docs/extending.md)."""
    self_model: Path | None = None
    """Weights of the robot's self-model; those that ship unless given."""
    guide: str = "auto"
    """How to infer: auto (amortized for people for whom its draws are reliable, if there is a
    network of this human model, else importance; the output names the engine of each person),
    importance (what people see summed out exactly, how they decide by importance sampling),
    amortized (the same, proposed at once by a trained network), svi (variational) or nuts
    (Hamiltonian Monte Carlo, slow)."""
    guide_file: Path | None = None
    """Network of the guides auto and amortized (see `python -m mirror_ppl.train --what guide`)."""
    pooling: str = "none"
    """none, or partial (partial pooling: the population that the people are from is inferred with
    them, and posterior.nc holds it)."""
    prior_from: Path | None = None
    """A posterior.nc of --pooling partial, whose population is the prior of these people."""
    allow_contradictions: str = "0%"
    """Percentage of steps whose action may contradict the next observation, such as 2%: for
    recordings of noisy rigs. The summary counts them."""
    explore: int = 8
    """Rounds that are simulated of each scenario, to find the one that is most informative about
    what people see; 0 leaves it out."""
    steps: int | None = None
    """Gradient steps of svi; 300 unless given."""
    refine: int = 0
    """Of auto and amortized: gradient steps on each person's rounds that refine what the network
    proposes; none unless given."""
    draws: int = 200
    """Posterior draws."""
    seed: int = 0
    """Seed of everything random: the same seed gives the same summary."""
    jobs: int | None = None
    """Processes that share the people; -1 for one a core. Results do not depend on it. Default: as
    many as pay, and one with --device cuda."""
    scheduler: str | None = None
    """Address of a Dask cluster that does the work instead, such as tcp://host:8786."""
    keep: str = "means"
    """What posterior.nc keeps of predicted held-out actions: means over draws, or draws (also of
    all sites of the prior; a larger file)."""
    device: str = "cpu"
    """Where to compute: cpu, cuda or cuda:0."""

    def __post_init__(self) -> None:
        if self.guide_file is not None and self.guide not in ("auto", "amortized"):
            raise OptionError("--guide-file is for --guide auto and amortized")
        if self.prior_from is not None and self.pooling != "none":
            raise OptionError("--prior-from is for people who are not pooled; leave out --pooling")
        if self.refine and self.guide not in ("auto", "amortized"):
            raise OptionError("--refine is for --guide auto and amortized")
        check_numbers(self, "steps", "draws", "train_rounds", "explore", "refine", "seed", "jobs")
        if self.steps is not None and self.guide != "svi":
            raise OptionError("--steps is for --guide svi")
        share(self.allow_contradictions, "--allow-contradictions")


def main(options: Options) -> None:
    """Fit, write the results, and print what was found.

    Raises:
        MirrorError: what was asked for cannot be done; nothing is written then.
    """
    began = monotonic()
    from mirror_ppl.domains import get_domain
    from mirror_ppl.evaluation.fit_report import show_fit
    from mirror_ppl.face import infer
    from mirror_ppl.files import output_folder
    from mirror_ppl.fitted import RESULTS
    from mirror_ppl.inference.results.posterior_file import POSTERIOR
    from mirror_ppl.inference.svi import SVIOptions
    from mirror_ppl.inference.workers import Workers, parts_of

    recordings = _recordings(options)
    engine = told_engine(options.guide)
    allowed = share(options.allow_contradictions, "--allow-contradictions")
    _require_memory(recordings, options)
    replaced = "; it replaces an earlier one" if (options.out / POSTERIOR).exists() else ""
    results = output_folder(options.out, (*RESULTS, CHECKPOINT), parts=[f"{CHECKPOINT}.parts"])
    with results as folder, Stages() as stages, warnings.catch_warnings():
        for reported in (PriorConflict, UnreliableWeights):
            warnings.simplefilter("ignore", reported)
        fit = infer(
            recordings,
            human=options.human_model,
            engine=engine,
            pooling=options.pooling,
            seed=options.seed,
            draws=options.draws,
            train_rounds=options.train_rounds,
            settings=None if options.steps is None else SVIOptions(steps=options.steps),
            refine=options.refine,
            explore=options.explore,
            allow_contradictions=allowed,
            prior_from=options.prior_from,
            guide_file=options.guide_file,
            self_model=options.self_model,
            device=options.device,
            jobs=1 if options.jobs is None and options.device != "cpu" else options.jobs,
            scheduler=options.scheduler,
            keep=options.keep,
            report=stages.report,
            checkpoint=folder / CHECKPOINT,
        )
        seconds = round(monotonic() - began, 1)
        pictures = fit.save(folder, seconds=seconds)
        Workers(folder=parts_of(folder / CHECKPOINT)).clean()
        for file in folder.glob(f"{CHECKPOINT}*"):
            if CHECKPOINTS.fullmatch(file.name) and file.is_file():
                file.unlink()
    show_fit(fit.summary | {"seconds": seconds}, get_domain(recordings.domain).reach_unit)
    what = "posterior and predictions, as ArviZ InferenceData"
    print(f"{folder / POSTERIOR}: {what}{replaced}")
    print(f"{folder / 'summary.json'}: the numbers above")
    for name, shows in pictures.items():
        print(f"{folder / name}: {shows}")


def _require_memory(demonstrations: Demonstrations, options: Options) -> None:
    """Refuse what will not fit, before any work is done."""
    from mirror_ppl.domains import get_domain
    from mirror_ppl.inference.results.fitting import split_rounds
    from mirror_ppl.inference.workers import Workers

    parts = [part for part in split_rounds(demonstrations, options.train_rounds) if part]
    actions = len(get_domain(demonstrations.domain).actions)
    steps = sum(part.actions[0].numel() for part in parts)
    people = demonstrations.num_people
    processes = Workers(options.jobs).processes(people)
    values = options.draws * steps * actions * (people + COPIES * processes)
    require_memory(4 * values, "so many draws of predictions")


def _recordings(options: Options) -> Demonstrations:
    found = _all_recordings(options)
    return found.select_people(list(options.people)) if options.people else found


def _all_recordings(options: Options) -> Demonstrations:
    from mirror_ppl.domains import get_domain
    from mirror_ppl.face import load_recordings

    given = {name: getattr(options, name) for name in ("domain", "setting", "population")}
    if options.domain is not None and options.demos is not None:
        given["domain"] = get_domain(options.domain).name
    if options.demos is not None:
        recorded = load_recordings(options.demos)
        for name in ("domain", "setting"):
            if given[name] not in (None, own := getattr(recorded, name)):
                raise OptionError(
                    f"--{name} is {given[name]}, but --demos is of {own}; leave one out"
                )
        if options.population is not None:
            raise OptionError("--population is of the shipped recordings; leave it or --demos out")
        return recorded
    return load_recordings(**given)

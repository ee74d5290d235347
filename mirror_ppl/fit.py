"""`python -m mirror_ppl.fit`: infer what people see and how they decide."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from mirror_ppl.console import Stages, run, usable_device
from mirror_ppl.errors import OptionError

PROGRAM = "python -m mirror_ppl.fit"
DOMAIN, POPULATION = "driving", "paper"
DESCRIPTION = """Infer from recorded rounds what each person sees and how they decide, with the
uncertainty of it, and measure how well their held-out actions are predicted. Without --demos the
recordings of ten simulated people are used that ship with the package. Writes posterior.nc (ArviZ
InferenceData), summary.json, pictures of what they see, and open.png. A fit that is stopped goes on
from its checkpoint when the same command is given again."""


@dataclass(frozen=True)
class Options:
    """What to fit, and where the results go."""

    demos: Path | None = None
    """Recordings in the format of docs/demonstrations.md."""
    domain: str | None = None
    """The world of the shipped recordings: driving (unless given), search_rescue or bomb_defusal.
    """
    setting: str | None = None
    """The setting of the shipped recordings: clear or fog in driving, clear or smoke in
    search_rescue, labelled or unlabelled in bomb_defusal. Default: the one in which people see
    less."""
    population: str | None = None
    """The people of the shipped recordings: paper (unless given; sight limited by the setting
    alone, in bomb_defusal as quick at every terminal) or diverse (each their own sight)."""
    out: Path = Path("runs/fit")
    """Folder for the results; made if it is not there."""
    train_rounds: int | None = None
    """How many rounds of each person to learn from, from the first on; 0 for none. Default: 20 of
    recordings with 36 rounds or more (rounds 31 to 36 are held out), else three quarters."""
    human_model: str | None = None
    """Another human model: one-radius, per-item, perceptual-only, policy-only or no-implants, or
    one of your own, path/to/file.py:Class (see docs/extending.md)."""
    self_model: Path | None = None
    """Weights of the robot's self-model; those that ship unless given."""
    guide: str = "exact"
    """How to infer: exact (what people see marginalized, how they decide by importance sampling),
    amortized (the same, proposed at once by a trained network), svi (variational) or nuts
    (Hamiltonian Monte Carlo, slow)."""
    guide_file: Path | None = None
    """Network of the guide amortized (see `python -m mirror_ppl.train --what guide`)."""
    pooling: str = "none"
    """Whether people tell of each other: none, or partial (the population that they are from is
    inferred with them, and posterior.nc holds it)."""
    prior_from: Path | None = None
    """A posterior.nc of --pooling partial, whose population is the prior of these people."""
    explore: int = 8
    """Rounds that the model plays in each scenario, to say which would tell more of what people
    see; 0 leaves it out."""
    steps: int = 300
    """Gradient steps of svi."""
    refine: int = 0
    """Gradient steps of svi that start at what amortized or exact found; none unless given."""
    draws: int = 200
    """Posterior draws."""
    seed: int = 0
    """Seed of everything random: the same seed gives the same summary."""
    device: str = "cpu"
    """Where to compute: cpu, cuda or cuda:0."""

    def __post_init__(self) -> None:
        if self.guide_file is not None and self.guide != "amortized":
            raise OptionError("--guide-file is for --guide amortized")
        if self.prior_from is not None and self.pooling != "none":
            raise OptionError("--prior-from is for people who are not pooled; leave out --pooling")
        if self.refine and self.guide not in ("amortized", "exact"):
            raise OptionError("--refine is for --guide amortized and exact")
        least_of = {"steps": 1, "draws": 1, "train_rounds": 0, "explore": 0, "refine": 0}
        for name, least in least_of.items():
            number = getattr(self, name)
            if number is not None and number < least:
                option = f"--{name.replace('_', '-')}"
                raise OptionError(f"{option} must be at least {least}, not {number}")


def main(options: Options) -> None:
    """Fit, write the results, and print what was found.

    Raises:
        MirrorError: what was asked for cannot be done; nothing is written then.
    """
    began = monotonic()
    demonstrations = _recordings(options)
    from mirror_ppl.domains import get_domain
    from mirror_ppl.evaluation.fit_report import show_fit
    from mirror_ppl.files import prepare_output_folder, write_whole
    from mirror_ppl.inference.export import add_identifiability, save_inference_data
    from mirror_ppl.inference.fitting import fit_people, split_rounds
    from mirror_ppl.inference.guide_file import network_for
    from mirror_ppl.inference.guides import InferenceOptions
    from mirror_ppl.inference.identifiability import identify
    from mirror_ppl.inference.pooling import Pooling
    from mirror_ppl.inference.population_file import load_population
    from mirror_ppl.inference.recorded import check_world
    from mirror_ppl.inference.svi import FitOptions
    from mirror_ppl.models.loading import check_contract, load_human_model
    from mirror_ppl.models.weights import load_self_model, shipped_weights
    from mirror_ppl.plots.identifiability import plot_identifiability
    from mirror_ppl.plots.sight import FILES, sight_pictures

    device = usable_device(options.device)
    svi = FitOptions(steps=options.steps)
    settings = InferenceOptions(
        options.guide, options.draws, svi, pooling=options.pooling, refine=options.refine
    )
    weights = options.self_model or shipped_weights(demonstrations.domain)
    self_model, _ = load_self_model(weights, demonstrations.domain)
    human = load_human_model(options.human_model, self_model.to(device))
    check_contract(human)
    network = network_for(options.guide, options.guide_file, human)
    population = None
    if options.prior_from is not None:
        pooling = Pooling(human)
        population = load_population(options.prior_from, pooling, demonstrations.setting)
    # Faults of the recordings come to light before anything is written.
    check_world(demonstrations)
    split_rounds(demonstrations, options.train_rounds)
    folder = prepare_output_folder(options.out)
    checkpoint = folder / "fit.checkpoint"
    with Stages() as stages:
        result = fit_people(
            human,
            demonstrations.to(device),
            settings,
            options.seed,
            options.train_rounds,
            stages.report,
            checkpoint,
            network,
            population,
        )
        found = identify(
            human,
            result.train,
            result.posterior.draws,
            options.seed,
            result.posterior.population,
            stages.report,
            options.explore,
        )
    if found is not None:
        scenarios = get_domain(demonstrations.domain).scenarios
        for number, person in enumerate(result.summary["people"]):
            person["identifiability"] = found.of(number, scenarios)
        add_identifiability(result.data, found, result.data["posterior"].attrs)
    if options.prior_from is not None:
        result.summary["prior_from"] = str(options.prior_from)
    summary = result.summary | {"seconds": round(monotonic() - began, 1)}
    text = json.dumps(summary, indent=1) + "\n"
    # Without it, results of a run that was killed here cannot be taken for those of an older one.
    for name in ("summary.json", "open.png", *FILES):
        (folder / name).unlink(missing_ok=True)
    save_inference_data(result.data, folder / "posterior.nc")
    pictures = sight_pictures(result.data)
    for name, (picture, _) in pictures.items():
        picture.save(folder / name)
    drawn = found is not None and not found.nothing
    if drawn:
        plot_identifiability(result.data).save(folder / "open.png")
    write_whole(folder / "summary.json", lambda temporary: temporary.write_text(text))
    for file in folder.glob("fit.checkpoint*"):
        file.unlink()
    show_fit(summary, get_domain(demonstrations.domain).reach_unit)
    print(f"{folder / 'posterior.nc'}: posterior and predictions, as ArviZ InferenceData")
    print(f"{folder / 'summary.json'}: the numbers above")
    for name, (_, shows) in pictures.items():
        print(f"{folder / name}: {shows}")
    if drawn:
        print(f"{folder / 'open.png'}: what is open about what they see, and what would tell")


def _recordings(options: Options):
    from mirror_ppl.data import asset_path, load_demonstrations
    from mirror_ppl.domains import get_domain, require_known
    from mirror_ppl.people import PEOPLE

    if options.demos is not None:
        recorded = load_demonstrations(options.demos)
        for name in ("domain", "setting"):
            given, own = getattr(options, name), getattr(recorded, name)
            if given not in (None, own):
                raise OptionError(f"--{name} is {given}, but --demos is of {own}; leave one out")
        if options.population is not None:
            raise OptionError("--population is of the shipped recordings; leave it or --demos out")
        return recorded
    domain = options.domain or DOMAIN
    settings = get_domain(domain).settings
    setting = require_known(options.setting or settings[-1], "setting", settings, domain)
    population = options.population or POPULATION
    require_known(population, "population", PEOPLE[domain].populations, domain)
    name = f"{domain}_{setting}_{population}.nc"
    return load_demonstrations(asset_path(name))


if __name__ == "__main__":
    raise SystemExit(run(Options, main, prog=PROGRAM, description=DESCRIPTION))

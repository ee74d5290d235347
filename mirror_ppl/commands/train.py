"""`python -m mirror_ppl.train`: train a self-model or a guide."""

import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from mirror_ppl.console import command_line
from mirror_ppl.devices import usable_device
from mirror_ppl.errors import OptionError
from mirror_ppl.limits import check_numbers
from mirror_ppl.progress import Progress, Stages

LEAST_PEOPLE = 10
PROGRAM = "python -m mirror_ppl.train"
DESCRIPTION = """Train the robot's self-model from nothing, or a guide that infers people at once,
measure it, and write its weights and a card with settings and quality. A self-model is measured
against the exact planner; it takes about ten minutes in driving, half an hour in search_rescue and
bomb_defusal, and more than an hour in highway. A guide learns from people who are drawn from the
human model's prior; it takes about half an hour. The same command resumes a stopped run."""
EXAMPLES = {
    "the self-model that ships, from nothing": (
        "--domain driving --out runs/driving_self_model.safetensors"
    ),
    "a network that infers people of a human model at once": (
        "--what guide --human-model one-radius --people 1000"
    ),
}
"""Arguments, by what they are for."""
SELF_MODEL, GUIDE = "self-model", "guide"
OF_SELF_MODEL = ("phases", "steps", "learning_rate", "speech", "sizes", "device", "jobs")
OF_GUIDE = ("people", "elbo_steps", "dropout", "human_model", "self_model")


@dataclass(frozen=True)
class Options:
    """What to train, and where to."""

    what: str = SELF_MODEL
    """What to train: self-model or guide."""
    out: Path | None = None
    """The weights file to write; its card can be read with `python -m mirror_ppl.train --card`.
    Default: runs/driving_self_model.safetensors or runs/driving_guide.safetensors, by the name of
    the domain."""
    domain: str = "driving"
    """The world to learn: driving (two lanes, four cars that never yield), search_rescue (a
    burning house, a victim, two corridors), bomb_defusal (three stages, six terminals) or highway
    (three lanes, lidar); or one of your own, path/to/file.py:Class, whose code is run
    (docs/adding_a_world.md)."""
    phases: int | None = None
    """Of a self-model: phases of acting and learning; 2 to try it out. Default: what makes a good
    one, of driving 40, of search_rescue 400, of bomb_defusal 200 and of highway 12."""
    steps: int | None = None
    """Of a self-model: gradient steps of a phase. Default: of driving 300,
    of search_rescue 40, of bomb_defusal 30, of highway 2500."""
    learning_rate: float | None = None
    """Of a self-model: learning rate at the start; it falls to a hundredth. Default: of driving
    0.001, of search_rescue 0.002, of bomb_defusal 0.002, of highway 0.001."""
    speech: str = "words"
    """Of a self-model: what makes numbers of utterances, words or gpt2 (the supplement's; needs the
    extra "speech" and its weights)."""
    sizes: str = "shipped"
    """Of a self-model: sizes of the networks, shipped or paper (the supplement's, which differ in
    bomb_defusal: a Q-network of 3 x 2048)."""
    people: int = 1000
    """Of a guide: people to learn from, simulated in the true domain."""
    elbo_steps: int = 0
    """Of a guide: gradient steps of the ELBO among those of inference compilation."""
    dropout: float = 0.2
    """Of a guide: share of the network's units that are left out at a step, from 0 to below 1; more
    where a human model has many sites, or people are few."""
    human_model: str | None = None
    """Of a guide: another human model: one-radius, per-item, perceptual-only and so on, or
    one of your own, path/to/file.py:Class, whose code is run (see docs/extending.md)."""
    self_model: Path | None = None
    """Of a guide: weights of the robot's self-model; those that ship unless given."""
    seed: int = 0
    """Seed of everything random."""
    device: str = "cpu"
    """Where to compute: cpu, cuda or cuda:0."""
    jobs: int = -1
    """Of a self-model: processes that step a slow environment of your own world; -1 for one a
    core."""
    card: Path | None = None
    """Do not train: print the card of this weights file."""

    def __post_init__(self) -> None:
        if self.what not in (SELF_MODEL, GUIDE):
            raise OptionError(f"--what must be {SELF_MODEL} or {GUIDE}, not {self.what}")
        check_numbers(self, "phases", "steps", "elbo_steps", "seed", "jobs", people=LEAST_PEOPLE)
        other, of_other = (SELF_MODEL, OF_SELF_MODEL) if self.what == GUIDE else (GUIDE, OF_GUIDE)
        defaults = {field.name: field.default for field in fields(self)}
        for name in of_other:
            if getattr(self, name) != defaults[name]:
                raise OptionError(f"--{name.replace('_', '-')} is for --what {other}")
        if not 0 <= self.dropout < 1:
            raise OptionError(f"--dropout must be at least 0 and below 1, not {self.dropout}")
        rate = self.learning_rate
        if rate is not None and not 0 < rate <= 1:
            raise OptionError(f"--learning-rate must be above 0 and at most 1, not {rate}")


def main(options: Options) -> None:
    """Train, measure, write, and print what was reached.

    Raises:
        UnknownNameError: there is no such domain or device.
        AssetError: a file that was named cannot be read.
        HumanModelError: the human model breaks its contract.
        OutputError: the file cannot be written.
        CheckpointError: a checkpoint of a run with other options is in the way.
    """
    from mirror_ppl.domains import get_domain
    from mirror_ppl.files import lock_of, output_folder, require_files_of_their_own

    if options.card is not None:
        _show(_card(options.card))
        return
    domain = get_domain(options.domain).name
    name = options.what.replace("-", "_")
    out = options.out or Path("runs") / f"{domain}_{name}.safetensors"
    inputs = {"--self-model": [options.self_model]}
    require_files_of_their_own({"--out": out}, inputs)
    checkpoint = out.with_suffix(".checkpoint")
    with output_folder(out.parent, [out.name, checkpoint.name], lock_of(out)):
        card = (_guide if options.what == GUIDE else _self_model)(options, out, checkpoint)
        checkpoint.unlink(missing_ok=True)
    _show(card)
    print(f"weights and card: {out}")


def _self_model(options: Options, out: Path, checkpoint: Path) -> dict[str, Any]:
    import torch

    from mirror_ppl.domains import get_domain, require_known
    from mirror_ppl.evaluation.self_model import self_model_quality
    from mirror_ppl.models.sizes import sizes_of
    from mirror_ppl.models.speech import EMBEDDINGS
    from mirror_ppl.models.weights import save_self_model
    from mirror_ppl.stepping import stepped_by
    from mirror_ppl.training.self_model import train_self_model
    from mirror_ppl.training.self_model_options import SelfModelOptions

    default, *_ = EMBEDDINGS
    if require_known(options.speech, "speech", tuple(EMBEDDINGS)) != default and not any(
        modality.utterances for modality in get_domain(options.domain).modalities
    ):
        raise OptionError(f"--speech: nothing is put into words in {options.domain}")
    domain = get_domain(options.domain)
    known = ("shipped", "paper")
    sizes = sizes_of(domain, paper=require_known(options.sizes, "sizes", known) == "paper")
    settings = SelfModelOptions.of(
        domain.name,
        phases=options.phases,
        steps=options.steps,
        learning_rate=options.learning_rate,
    )
    generator = torch.Generator(usable_device(options.device)).manual_seed(options.seed)
    with (
        stepped_by(options.jobs, domain.as_believed),
        Progress("train", settings.phases) as progress,
    ):
        self_model = train_self_model(
            domain.as_believed,
            settings,
            generator,
            progress.update,
            checkpoint,
            options.speech,
            sizes,
        )
    # It was taught the world as it is believed to be, and lives in the world as it is.
    self_model.domain = domain
    with stepped_by(options.jobs, domain), Stages() as stages:
        quality = self_model_quality(
            self_model,
            discount=settings.discount,
            progress=lambda done, total: stages.report("measure", done, total, "views"),
        )
    card = _described(options, settings, quality, f"measured on {domain.record.measured} rounds")
    save_self_model(self_model, out, card)
    return card


def _guide(options: Options, out: Path, checkpoint: Path) -> dict[str, Any]:
    from mirror_ppl.domains import get_domain
    from mirror_ppl.likelihood.contract import check_contract
    from mirror_ppl.models.loading import load_human_model
    from mirror_ppl.models.weights import load_self_model, shipped_weights
    from mirror_ppl.models.world_knowledge import fit_shipped_world
    from mirror_ppl.training.guide import GuideOptions, train_guide
    from mirror_ppl.training.guide_file import save_guide

    domain = get_domain(options.domain).name
    weights = options.self_model or shipped_weights(domain)
    self_model, _ = load_self_model(weights, domain)
    human = load_human_model(options.human_model, self_model)
    check_contract(human)
    # What is so for everybody is learned first, as by a fit: people are drawn from what is open.
    fit_shipped_world(human, human.domain.settings[-1])
    settings = GuideOptions(
        people=options.people, elbo_steps=options.elbo_steps, dropout=options.dropout
    )
    with Stages() as stages:
        guide, quality = train_guide(human, settings, options.seed, stages.report, checkpoint)
    card = _described(options, settings, quality, "nats a person, of people held out")
    save_guide(guide, human, out, card)
    if quality["learned"] <= 0:
        print("This guide knows no more than the prior; give it more --people")
    return card


def _described(options: Options, settings: Any, quality: dict[str, float], measured: str) -> dict:
    import torch

    from mirror_ppl.version import __version__

    return {
        "command": _command(options),
        "versions": {"mirror_ppl": __version__, "torch": torch.__version__.split("+")[0]},
        "settings": asdict(settings),
        "measured": measured,
        "quality": {name: round(value, 4) for name, value in quality.items()},
    }


def _card(path: Path) -> dict[str, Any]:
    """The card of a weights file."""
    from mirror_ppl.models import weights
    from mirror_ppl.training import guide_file

    return weights.read_card(path, {weights.FORMAT: "self-model", guide_file.FORMAT: "guide"})


def _command(options: Options) -> str:
    """The command that does it again; without what does not matter to what is trained."""
    left_out = {"out", "card", "jobs", *(OF_SELF_MODEL if options.what == GUIDE else OF_GUIDE)}
    values = {
        part.name: getattr(options, part.name)
        for part in fields(options)
        if part.name not in left_out
    }
    return command_line(PROGRAM, values)


def _show(card: dict) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=card["command"], title_justify="left")
    table.add_column(card.get("measured", "measured on 4000 rounds"))
    table.add_column("value", justify="right")
    for name, value in card["quality"].items():
        shown = "-" if value is None or math.isnan(value) else f"{value:.3f}"
        table.add_row(name.replace("_", " "), shown)
    Console().print(table)

"""`python -m mirror_ppl.train`: train a domain's self-model."""

from dataclasses import asdict, dataclass, fields
from math import isfinite
from pathlib import Path

from mirror_ppl.console import Progress, run, usable_device
from mirror_ppl.errors import OptionError

PROGRAM = "python -m mirror_ppl.train"
DESCRIPTION = """Train the robot's self-model from nothing, measure it against the exact planner,
and write its weights with a card that tells both. Takes about ten minutes on two cores. A run that
is stopped goes on from its last finished phase when the same command is given again."""


@dataclass(frozen=True)
class Options:
    """What to train, and where to."""

    out: Path = Path("runs/driving_self_model.safetensors")
    """The weights file to write; its card can be read with `python -m mirror_ppl.train --card`."""
    domain: str = "driving"
    """The world to learn. So far there is driving: two lanes, four cars that never yield."""
    phases: int = 40
    """Phases of driving and learning; 2 are enough to try it out, 40 to be good."""
    steps: int = 300
    """Gradient steps of a phase."""
    learning_rate: float = 1e-3
    """Learning rate at the start; it falls to a hundredth."""
    seed: int = 0
    """Seed of everything random."""
    device: str = "cpu"
    """Where to compute: cpu, cuda or cuda:0."""
    card: Path | None = None
    """Do not train: print the card of this weights file."""

    def __post_init__(self) -> None:
        for name in ("phases", "steps"):
            if (number := getattr(self, name)) < 1:
                raise OptionError(f"--{name} must be at least 1, not {number}")
        if not (self.learning_rate > 0 and isfinite(self.learning_rate)):
            raise OptionError(
                f"--learning-rate must be a positive number, not {self.learning_rate}"
            )


def main(options: Options) -> None:
    """Train, measure, write, and print what was reached.

    Raises:
        UnknownNameError: there is no such domain or device.
        AssetError: the file whose card was asked for cannot be read.
        OutputError: the file cannot be written.
        CheckpointError: a checkpoint of a run with other options is in the way.
    """
    import torch

    from mirror_ppl import __version__
    from mirror_ppl.domains import get_domain
    from mirror_ppl.evaluation.self_model import self_model_quality
    from mirror_ppl.files import prepare_output_folder
    from mirror_ppl.inference.self_model_training import SelfModelOptions, train_self_model
    from mirror_ppl.models.weights import load_self_model, save_self_model

    if options.card is not None:
        _show(load_self_model(options.card)[1])
        return
    domain = get_domain(options.domain)
    settings = SelfModelOptions(
        phases=options.phases, steps=options.steps, learning_rate=options.learning_rate
    )
    prepare_output_folder(options.out.parent)
    checkpoint = options.out.with_suffix(".checkpoint")
    generator = torch.Generator(usable_device(options.device)).manual_seed(options.seed)
    with Progress("train", settings.phases) as progress:
        self_model = train_self_model(domain, settings, generator, progress.update, checkpoint)
    quality = self_model_quality(self_model, discount=settings.discount)
    card = {
        "command": _command(options),
        "versions": {"mirror_ppl": __version__, "torch": torch.__version__.split("+")[0]},
        "settings": asdict(settings),
        "quality": {name: round(value, 4) for name, value in quality.items()},
    }
    save_self_model(self_model, options.out, card)
    checkpoint.unlink(missing_ok=True)
    _show(card)
    print(f"weights and card: {options.out}")


def _command(options: Options) -> str:
    kept = [part.name for part in fields(options) if part.name not in ("out", "card")]
    parts = [f"--{name.replace('_', '-')} {getattr(options, name)}" for name in kept]
    return " ".join([PROGRAM, *parts])


def _show(card: dict) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=card["command"], title_justify="left")
    table.add_column("measured on 4000 rounds")
    table.add_column("value", justify="right")
    for name, value in card["quality"].items():
        table.add_row(name.replace("_", " "), f"{value:.3f}")
    Console().print(table)


if __name__ == "__main__":
    raise SystemExit(run(Options, main, prog=PROGRAM, description=DESCRIPTION))

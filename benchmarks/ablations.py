"""Ablations of this package's own choices, for drivers in fog.

    python -m benchmarks.ablations

Each row replaces one choice. Shown are held-out NLL (nats per action) and net return per round with
the communicator ``mirror``, for ten people a seed with 20 rounds each, and the advantage of the
package in the same people. The table is printed and, for a page, written to ``ablations.md``.

- ``relaxed``: sight thresholds on a continuous scale by a mean-field guide, where beliefs are the
  encoder's means, reparameterized draws, or draws without gradients (``benchmarks._relaxed``).
- ``plug-in``: one draw for each person in the place of all, the one whose predictions of the rounds
  that were learned from are nearest to the mean of all.
- ``no item dropout``: a self-model in whose training no items were dropped at random; limited sight
  stays. ``full views``: one that saw everything in every round.
- ``action shifted``: a self-model whose transition is of the action one step earlier.

These self-models are trained into the folder first, unless they are there. They are compared with
``retrained``, which is the package's own training with the same seed; all others with ``package``.
``svi`` has the package's thresholds and the mean-field guide that ``relaxed`` has, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

from benchmarks._relaxed import Latents, relaxed_draws
from mirror_ppl.domains import get_domain
from mirror_ppl.evaluation.assistance import PlannerOptions, play, speaker
from mirror_ppl.evaluation.learners import TEST, TRAINING, Group, Posterior
from mirror_ppl.evaluation.study_report import difference
from mirror_ppl.evaluation.study_summary import paired
from mirror_ppl.evaluation.tables import TextTable, page
from mirror_ppl.files import write_whole
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.inference.results.summary import predictive, score
from mirror_ppl.models.distributions import GaussianChain
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.weights import load_self_model, save_self_model
from mirror_ppl.progress import Progress
from mirror_ppl.training.self_model import train_self_model
from mirror_ppl.training.self_model_options import SelfModelOptions

DOMAIN, SETTING = "driving", "fog"
DRAWS = 200
PLANNED_WITH = 64
PACKAGE = "package"


@dataclass(frozen=True)
class Options:
    """What to measure."""

    choices: tuple[str, ...] = ()
    """Rows of the table; all of them unless given."""
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of the people."""
    people: int = 10
    """People of each seed."""
    played: int = 5
    """Rounds of each person in which they are spoken to."""
    training_seed: int = 0
    """Seed of the self-models."""
    phases: int | None = None
    """Phases of their training, as many as of those that ship unless given."""
    out: Path = Path("runs/ablations")
    """Folder of the self-models."""


@dataclass(frozen=True)
class Measured:
    """What was found of a choice; a number for each person.

    Attributes:
        nll: of held-out actions, nats an action.
        net: return of a round with the communicator, less what messages cost.
    """

    nll: list[float]
    net: list[float]


class ShiftedTransition(SelfModel):
    """A self-model whose transition is ``p(z_t | z_{t-1}, a_{t-2})``, as if by mistake."""

    def dynamics(self, actions: Tensor) -> GaussianChain:
        """The same of the actions of one step earlier; of the first action before there was one."""
        return super().dynamics(torch.cat([actions[..., :1], actions[..., :-1]], -1))


TRAINED: Mapping[str, tuple[type[SelfModel], dict[str, Any]]] = {
    "retrained": (SelfModel, {}),
    "no item dropout": (SelfModel, {"kinds": (0.2, 0.0, 0.8)}),
    "full views": (SelfModel, {"kinds": (1.0, 0.0, 0.0)}),
    "action shifted": (ShiftedTransition, {}),
}
RELAXED: Mapping[str, Latents] = {
    "relaxed": "mean",
    "relaxed, rsample": "rsample",
    "relaxed, sample": "sample",
}
REFERENCE = "retrained"
CHOICES = (PACKAGE, "plug-in", "svi", *RELAXED, *TRAINED)


def main(options: Options) -> None:
    """Run the study."""
    torch.set_num_threads(1)
    chosen = [name for name in CHOICES if name in (options.choices or CHOICES)]
    unknown = {*options.choices} - {*CHOICES}
    if unknown:
        raise SystemExit(f"no such choice: {', '.join(sorted(unknown))}; known: {CHOICES}")
    options.out.mkdir(parents=True, exist_ok=True)
    found: dict[str, Measured] = {}
    partners = [PACKAGE, *([REFERENCE] if {*TRAINED} & {*chosen} else [])]
    for name in dict.fromkeys([*partners, *chosen]):
        found[name] = measure(name, human_of(name, options), options)
        print("   ".join(entry.replace("\n", " ") for entry in row(found, name)), flush=True)
    write_whole(options.out / "ablations.md", page([], [table(found, options)]))


def measure(name: str, human: HumanModel, options: Options) -> Measured:
    """How it predicts and helps the people of all seeds."""
    nll, net = [], []
    for seed in options.seeds:
        group = Group(DOMAIN, SETTING, "paper", options.people, seed)
        posterior = learned(name, human, group)
        test = group.recordings().select_rounds(TEST)
        scores = score(posterior.log_predictive(test)[None], test)
        nll.extend(one["nll"] for one in scores if one is not None)
        net.extend(net_returns(posterior, group, options.played))
    return Measured(nll, net)


def table(found: Mapping[str, Measured], options: Options) -> TextTable:
    """All rows."""
    people = options.people * len(options.seeds)
    return TextTable(
        f"{DOMAIN}, {SETTING}: ablations of this package's own choices",
        f"mean over {people} people with {TRAINING} training rounds each; below it the advantage "
        f"of the reference with its 90% interval; the reference is {REFERENCE} for self-models "
        f"that were trained otherwise, and {PACKAGE} for all others",
        ("choice", "NLL (nats per action)", "net return per round"),
        tuple(row(found, name) for name in found),
    )


def row(found: Mapping[str, Measured], name: str) -> tuple[str, str, str]:
    """One choice: its name, NLL and net return."""
    own, entries = found[name], []
    partner = REFERENCE if name in TRAINED and name != REFERENCE else PACKAGE
    for values, others, sign, digits in (
        (own.nll, found[partner].nll, -1, 3),
        (own.net, found[partner].net, 1, 2),
    ):
        entry = f"{np.mean(values):.{digits}f}"
        if name != PACKAGE:
            ahead = paired(sign * np.array(others), sign * np.array(values)).ahead
            entry += f"\n{difference(ahead, digits)}"
        entries.append(entry)
    return name, entries[0], entries[1]


def human_of(name: str, options: Options) -> HumanModel:
    """The human model, with a self-model that is trained if need be."""
    if name not in TRAINED:
        return load_human_model(None, Group(DOMAIN, SETTING, "paper", 1, 0).self_model)
    kind, changes = TRAINED[name]
    phases = "" if options.phases is None else f"-{options.phases}"
    stem = f"{name.replace(' ', '_')}-{options.training_seed}{phases}"
    path = options.out / f"{stem}.safetensors"
    if not path.exists():
        settings = SelfModelOptions.of(DOMAIN, phases=options.phases, **changes)
        with Progress(f"train {name}", settings.phases) as progress:
            trained = train_self_model(
                get_domain(DOMAIN),
                settings,
                torch.Generator().manual_seed(options.training_seed),
                progress.update,
                options.out / f"{stem}.checkpoint",
                kind=kind,
            )
        save_self_model(trained, path, {"choice": name})
    return load_human_model(None, load_self_model(path, DOMAIN)[0])


def learned(name: str, human: HumanModel, group: Group) -> Posterior:
    """What is inferred of a group."""
    train = group.recordings().select_rounds(slice(TRAINING))
    if name in RELAXED:
        return Posterior(human, relaxed_draws(human, train, RELAXED[name], DRAWS, group.seed))
    guide = "svi" if name == "svi" else "importance"
    draws = infer(human, train, InferenceOptions(guide, DRAWS), group.seed).draws
    if name == "plug-in":
        each = predict_rounds(human, train, draws)  # [S, P, B, T, A]
        mean = predictive(each)
        real = (train.actions >= 0)[..., None]
        nats = torch.where(real, mean.exp() * (mean - each), 0.0).sum((-3, -2, -1))  # [S, P]
        best = nats.argmin(0)
        people = torch.arange(len(best))
        draws = {site: value[best, people][None] for site, value in draws.items()}
    return Posterior(human, draws)


def net_returns(posterior: Posterior, group: Group, played: int) -> list[float]:
    """Net return of a round of each person, whom ``mirror`` speaks to."""
    options, found = PlannerOptions.of(DOMAIN), []
    for number, listener in enumerate(group.listeners(played)):
        listener = replace(listener, person=posterior.person(number, PLANNED_WITH))
        say = speaker("mirror", listener, options, group.seed + number)
        found.append(float(play(listener, say).net.mean()))
    return found


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

"""What this package's own choices are worth, in drivers in fog.

    python -m benchmarks.ablations

Each row gives up one choice. Shown are held-out NLL in nats an action, net return of a round with
the communicator ``mirror``, of ten people a seed with 20 rounds each, and how far the package is
ahead in the same people.

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
from mirror_ppl.console import Progress
from mirror_ppl.domains import get_domain
from mirror_ppl.evaluation.assistance import PlannerOptions, play, speaker
from mirror_ppl.evaluation.learners import TEST, TRAINING, Group, Posterior
from mirror_ppl.evaluation.study_summary import paired
from mirror_ppl.inference.fitting import predict_rounds
from mirror_ppl.inference.guides import InferenceOptions, infer
from mirror_ppl.inference.self_model_training import SelfModelOptions, train_self_model
from mirror_ppl.inference.summary import predictive, score
from mirror_ppl.models.distributions import GaussianChain
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.weights import load_self_model, save_self_model

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
    nll: dict[str, list[float]] = {}
    net: dict[str, list[float]] = {}
    partners = [PACKAGE, *([REFERENCE] if {*TRAINED} & {*chosen} else [])]
    for name in dict.fromkeys([*partners, *chosen]):
        human = human_of(name, options)
        for seed in options.seeds:
            group = Group(DOMAIN, SETTING, "paper", options.people, seed)
            posterior = learned(name, human, group)
            test = group.recordings().select_rounds(TEST)
            found = score(posterior.log_predictive(test)[None], test)
            nll.setdefault(name, []).extend(one["nll"] for one in found if one is not None)
            net.setdefault(name, []).extend(net_returns(posterior, group, options.played))
        print(
            f"{name:<18} NLL {np.mean(nll[name]):.3f} {against(nll, name, -1)}   "
            f"net {np.mean(net[name]):.2f} {against(net, name, 1)}",
            flush=True,
        )


def against(values: dict[str, list[float]], name: str, sign: int) -> str:
    """How far what it is compared with is ahead, with its 90% interval."""
    if name == PACKAGE:
        return f"{'':<24}"
    partner = REFERENCE if name in TRAINED and name != REFERENCE else PACKAGE
    ahead = paired(sign * np.array(values[partner]), sign * np.array(values[name])).ahead
    return f"{f'({ahead.mean:+.3f} [{ahead.low:+.3f}, {ahead.high:+.3f}])':<24}"


def human_of(name: str, options: Options) -> HumanModel:
    """The human model, with a self-model that is trained if need be."""
    if name not in TRAINED:
        return load_human_model(None, Group(DOMAIN, SETTING, "paper", 1, 0).self_model)
    kind, changes = TRAINED[name]
    options.out.mkdir(parents=True, exist_ok=True)
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
    guide = "svi" if name == "svi" else "exact"
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

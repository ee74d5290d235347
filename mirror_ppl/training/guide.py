"""Training of the amortized guide by inference compilation and, optionally, by the ELBO.

People are drawn from the prior and play rounds in the true domain. The guide learns to infer their
implants from the first n of these rounds, for several n::

    psi_p ~ prior;   rounds_p ~ program(psi_p);   minimize  - E log q(psi_p | first n rounds_p)

(Le, Baydin and Wood, *Inference compilation and universal probabilistic programming*, 2017). At its
minimum the guide is the posterior of every person, as far as its family can express it. ELBO steps
(:mod:`mirror_ppl.training.guide_elbo`) can be interleaved.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.checkpoints import read_checkpoint, save_checkpoint
from mirror_ppl.data import Demonstrations
from mirror_ppl.errors import HumanModelError, InputError
from mirror_ppl.inference.amortized import log_evidence
from mirror_ppl.inference.amortized_guide import (
    DROPOUT,
    PRIOR_DRAWS,
    AmortizedGuide,
    guide_screening,
    reference_places,
)
from mirror_ppl.inference.calibration.study import prior_people
from mirror_ppl.inference.engines import run_identity
from mirror_ppl.inference.hierarchical_proposal import dependent_sites
from mirror_ppl.likelihood.combinations import needs_points, perceived_names, why_points
from mirror_ppl.likelihood.densities import require_compilable
from mirror_ppl.likelihood.enumeration import require_acting_on_beliefs
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import sample_sites, scalar_sites, unconstrained
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.progress import Report, silent
from mirror_ppl.randomness import forked, seed_everything
from mirror_ppl.training.guide_elbo import ELBOTraining, Group, simulated_groups


@dataclass(frozen=True)
class GuideOptions:
    """Settings of training a guide.

    Attributes:
        people: number of people drawn from the prior.
        rounds: numbers of rounds after which evidence is computed, increasing.
        steps: gradient steps of inference compilation.
        elbo_steps: gradient steps of the ELBO, spread evenly among the others.
        batch: examples in a gradient step; each is a person and a number of rounds.
        learning_rate: initial rate of AdamW, annealed to 0 on a cosine.
        weight_decay: weight decay of AdamW.
        dropout: dropout rate of the network; should be higher for many sites or few people.
        held_out: share of the people held out for early stopping.
        together: people who are simulated at once.
    """

    people: int = 1000
    rounds: tuple[int, ...] = (1, 2, 3, 5, 8, 13, 20, 40)
    steps: int = 4000
    elbo_steps: int = 0
    batch: int = 256
    learning_rate: float = 1e-3
    weight_decay: float = 0.1
    dropout: float = DROPOUT
    held_out: float = 0.1
    together: int = 20

    def __post_init__(self) -> None:
        least_of = {"people": 10, "steps": 1, "elbo_steps": 0, "batch": 1, "together": 1}
        for name, least in least_of.items():
            if getattr(self, name) < least:
                raise InputError(f"{name} must be at least {least}, not {getattr(self, name)}")
        if not 0 <= self.dropout < 1:
            raise InputError(f"dropout must be at least 0 and below 1, not {self.dropout}")
        if not self.rounds or sorted({0, *self.rounds}) != [0, *self.rounds]:
            raise InputError(f"rounds must be positive and increase, not {self.rounds}")


@dataclass(frozen=True)
class Examples:
    """Training examples: N people, each at n numbers of rounds.

    Attributes:
        place: true implants in unconstrained space, ``[N, D]``.
        log_evidence: features that the network reads, ``[N, n, W]``.
        steps: recorded actions so far, ``[N, n]``.
    """

    place: Tensor
    log_evidence: Tensor
    steps: Tensor

    def __len__(self) -> int:
        return len(self.place)


def train_guide(
    human: HumanModel,
    options: GuideOptions,
    seed: int,
    report: Report = silent,
    checkpoint: Path | None = None,
) -> tuple[AmortizedGuide, dict[str, float]]:
    """Train a guide for a human model, and evaluate it on held-out people.

    Args:
        human: the model of people.
        options: settings.
        seed: seed of all random draws.
        report: called with progress: people simulated, gradient steps.
        checkpoint: file from which the simulation of people continues; updated during the run.

    Returns:
        The guide; and its mean loss on held-out people, the prior's loss, and their difference (the
        information gained from rounds), in nats per person.

    Raises:
        CheckpointError: the checkpoint is damaged or of another run.
        HumanModelError: the human model cannot be compiled.
    """
    require_compilable(human)
    if needs_points(human):
        raise HumanModelError(
            f"{why_points(human)}, which the network cannot learn; importance fits it without"
        )
    require_acting_on_beliefs(human, perceived_names(human))
    examples = simulate_examples(human, options, seed, report, checkpoint)
    with forked():
        seed_everything(seed)
        generator = torch.Generator().manual_seed(seed * 1_000_003 + options.people)
        groups = simulated_groups(human, options.rounds, generator)
        return _optimize(human, examples, options, groups, report)


def simulate_examples(
    human: HumanModel,
    options: GuideOptions,
    seed: int,
    report: Report = silent,
    checkpoint: Path | None = None,
) -> Examples:
    """Simulate people from the prior, and compute the log-evidence after each number of rounds."""
    run = run_identity(human, None, [seed, options.people, options.rounds, options.together])
    parts = _restored(checkpoint, run)
    done = sum(len(part) for part in parts)
    while done < options.people:
        report("simulate", done, options.people, "people")
        # Each group has its own seed, so that a resumed run equals an uninterrupted one.
        generator = torch.Generator().manual_seed(seed * 1_000_003 + done)
        number = min(options.together, options.people - done)
        implants = prior_people(human, number, generator)
        recordings = play_rounds(
            human, implants, options.rounds[-1], human.domain.settings[-1], generator
        )
        evidence, steps = zip(
            *(_evidence(human, recordings, person, options) for person in range(number)),
            strict=True,
        )
        place = unconstrained(scalar_sites(human), implants)
        parts.append(Examples(place, torch.stack(evidence), torch.stack(steps)))
        done += number
        if checkpoint is not None:
            save_checkpoint(checkpoint, run, {"parts": [vars(part) for part in parts]})
    report("simulate", done, options.people, "people")
    return Examples(*(torch.cat([vars(part)[name] for part in parts]) for name in vars(parts[0])))


def _evidence(
    human: HumanModel, recordings: Demonstrations, person: int, options: GuideOptions
) -> tuple[Tensor, Tensor]:
    builder = ViewTableBuilder(human, guide_screening())
    evidence, steps, total = [], [], 0
    first, rounds = 0, rounds_of(recordings, person)
    for number in sorted(options.rounds):
        some = rounds.at(first, number)
        builder.add(some)
        total, first = total + sum(some.steps), number
        if len(some):
            evidence.append(log_evidence(builder))
            steps.append(total)
    return torch.stack(evidence), torch.tensor(steps)


def _restored(checkpoint: Path | None, run: str) -> list[Examples]:
    if checkpoint is None or not checkpoint.exists():
        return []
    content = read_checkpoint(checkpoint, run)
    return [Examples(**part) for part in content["parts"]]


def _optimize(
    human: HumanModel,
    examples: Examples,
    options: GuideOptions,
    groups: Iterator[Group],
    report: Report,
) -> tuple[AmortizedGuide, dict[str, float]]:
    sites = scalar_sites(human)
    guide = AmortizedGuide(
        reference_places(human),
        reference_places(human, PRIOR_DRAWS),
        bool(dependent_sites(human, sites)),
        options.dropout,
    )
    held_out = max(1, round(options.held_out * len(examples)))
    learned = len(examples) - held_out
    numbers = examples.steps.shape[1]

    def loss(person: Tensor, number: Tensor) -> Tensor:
        """Mean negative log density of the true values under the guide."""
        place = examples.place[person][:, None]
        program = poutine.condition(guide, data={"place": place})
        evidence, steps = examples.log_evidence[person, number], examples.steps[person, number]
        trace = poutine.trace(program).get_trace(sites, evidence, steps)
        return -torch.as_tensor(trace.log_prob_sum()) / len(person)

    test = torch.cartesian_prod(torch.arange(learned, len(examples)), torch.arange(numbers)).T
    optimizer = torch.optim.AdamW(
        guide.parameters(), options.learning_rate, weight_decay=options.weight_decay
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, options.steps)
    by_elbo = ELBOTraining(guide, groups, options.learning_rate)
    best, kept = float("inf"), copy.deepcopy(guide.state_dict())
    report("train", 0, options.steps, "")
    for step in range(options.steps):
        guide.train()
        # ELBO steps due by now.
        due = (step + 1) * options.elbo_steps // options.steps
        for _ in range(step * options.elbo_steps // options.steps, due):
            by_elbo.step()
        optimizer.zero_grad()
        value = loss(
            torch.randint(learned, (options.batch,)), torch.randint(numbers, (options.batch,))
        )
        value.backward()
        torch.nn.utils.clip_grad_norm_(guide.parameters(), 10.0)
        optimizer.step()
        schedule.step()
        if step % 50 == 49 or step == options.steps - 1:
            guide.eval()
            with torch.no_grad():
                found = float(loss(*test))
            if found < best:
                best, kept = found, copy.deepcopy(guide.state_dict())
            report("train", step + 1, options.steps, f"held-out loss {found:.3f}")
    guide.load_state_dict(kept)
    prior = _prior_loss(human, examples, learned)
    quality = {"loss": best, "prior_loss": prior, "learned": prior - best}
    return guide.eval(), quality


def _prior_loss(human: HumanModel, examples: Examples, learned: int) -> float:
    """Loss of the prior in place of the guide."""
    given = {
        name: site(examples.place[learned:, column]).view(-1, 1, 1)
        for column, (name, site) in enumerate(scalar_sites(human).items())
    }
    number = len(examples) - learned
    with forked():
        nodes = sample_sites(human, 1, number, given)
    total = sum(nodes[name]["fn"].log_prob(value).sum() for name, value in given.items())
    return -float(total) / number

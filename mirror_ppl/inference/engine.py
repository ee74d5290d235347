"""The interface of engines, which infer the implants of people: their input and output."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.inference.workers import PersonAt, Workers
from mirror_ppl.likelihood.densities import BATCH
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import RESIDUAL
from mirror_ppl.progress import Report, silent
from mirror_ppl.randomness import person_seed

if TYPE_CHECKING:
    from mirror_ppl.inference.amortized_guide import AmortizedGuide
    from mirror_ppl.inference.population.pooling import Population


@dataclass(frozen=True)
class Inferred:
    """Posterior of P people.

    Attributes:
        draws: joint posterior draws by site, ``[S, P, 1, ...]``, as the human model samples them.
        pareto_k: Pareto k of importance weights ``[P]``, if there are any.
        log_evidence: log marginal likelihood ``[P]`` of each person's recorded actions under the
            model's own prior, nats, if the engine estimates it; NaN with factors or observed sites,
            where it is not defined, and with sampled attention, which adds noise to it.
        evidence_error: approximate standard error of it ``[P]``, nats.
        combinations: for each person, numbers ``[C]`` of the combinations of the discrete sites
            that perception reads which have all but a negligible part of the posterior
            probability, if the engine marginalizes over them.
        losses: negative ELBO at each step in nats, if one was optimized.
        population: posterior of the population, if people were pooled.
        effective: effective number ``[P]`` of each person's draws after pooling, if pooled.
        engines: name of the engine that inferred each person.
        seconds: processor time by stage; empty for engines that infer people together.
    """

    draws: Mapping[str, Tensor]
    pareto_k: Tensor | None = None
    log_evidence: Tensor | None = None
    evidence_error: Tensor | None = None
    combinations: tuple[Tensor, ...] = ()
    losses: tuple[float, ...] = field(default=())
    population: Population | None = None
    effective: Tensor | None = None
    engines: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)


def narrowed(draws: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Store the residual's weights in draws ``[S, P, 1, ...]`` with eight significant bits.

    They are of the size of their spread, so that further bits are negligible, and would take two
    thirds of a file.
    """
    return {
        name: value.bfloat16() if name in RESIDUAL and value.dim() > BATCH else value
        for name, value in draws.items()
    }


def widened(value: Tensor, like: Tensor) -> Tensor:
    """Convert narrowed draws of a site back to the human model's dtype."""
    return value.to(like.dtype) if value.dtype is torch.bfloat16 else value


@dataclass(frozen=True)
class Job:
    """Input of an engine: infer the implants of P people, each under the model's own prior.

    Attributes:
        human: the model of people.
        rounds: rounds of P people.
        draws: number of posterior draws S of each person.
        settings: settings of the engine, see :attr:`Engine.settings`.
        seed: seed of all random draws.
        screening: when to drop combinations of what perception reads and to merge moments;
            ``None`` for never.
        network: network of the amortized guide, if there is one.
        report: called with progress.
        checkpoint: a file that is written during the run and resumed from if it exists, and the
            identity of this run (a checkpoint of another run is refused).
        refine: gradient steps on each person's rounds that refine the network's proposal.
        workers: processes for engines that infer each person separately.
    """

    human: HumanModel
    rounds: Demonstrations
    draws: int
    settings: Any
    seed: int
    screening: Screening | None = None
    network: AmortizedGuide | None = None
    report: Report = silent
    checkpoint: tuple[Path, str] | None = None
    refine: int = 0
    workers: Workers = Workers()

    def seed_of(self, person: int) -> int:
        """Return the seed of one of the people, by their place; it depends on their id alone."""
        return person_seed(self.seed + 1, self.rounds.people[person])

    def of(self, people: range) -> Job:
        """The job for some of the people."""
        if len(people) == self.rounds.num_people:
            return self
        return replace(self, rounds=self.rounds.select_people(people))

    def alone(self, person: PersonAt) -> Job:
        """The job for one of the people, to be sent to another process."""
        own = self.of(person.range)
        return replace(own, report=silent, checkpoint=None, workers=Workers())


@dataclass(frozen=True)
class Engine:
    """An inference method for implants.

    Attributes:
        name: name for users.
        run: function that does a job.
        settings: class of the engine's settings; its defaults are used unless they are given.
        each_alone: True if it infers each person separately, so that people can be distributed over
            processes.
        pooled_draws: draws of each person under the model's own prior that pooling reweights.
        any_program: True if it runs human models that cannot be compiled.
        takes_network: True if it uses an amortized guide, if there is one.
        needs_network: True if it requires one.
    """

    name: str
    run: Callable[[Job], Inferred]
    settings: type
    each_alone: bool = False
    pooled_draws: int = 1000
    any_program: bool = False
    takes_network: bool = False
    needs_network: bool = False

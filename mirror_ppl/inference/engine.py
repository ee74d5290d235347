"""What an engine is: a way to infer the implants of people, and what it is given and returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.inference.workers import People, Workers
from mirror_ppl.likelihood.densities import BATCH
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.models.human import HumanModel
from mirror_ppl.progress import Report, silent

if TYPE_CHECKING:
    from mirror_ppl.inference.amortized_guide import AmortizedGuide
    from mirror_ppl.inference.population.pooling import Population


@dataclass(frozen=True)
class Inferred:
    """What was inferred of P people.

    Attributes:
        draws: joint posterior draws by site, ``[S, P, 1, ...]``, as the human model samples them.
        pareto_k: of importance weights ``[P]``, if there are any.
        log_evidence: log marginal likelihood ``[P]`` of each person's recorded actions under the
            model's own prior, nats, where an engine estimates it; NaN where it is not defined, with
            factors or observed sites, or attention whose values are drawn adds noise to it.
        losses: negative ELBO at each step in nats, if one was optimized.
        population: that people are from, if they were pooled.
        effective: number ``[P]`` of each person's own draws that pooling leaves, if they were.
        engines: name of the engine that inferred each person.
        seconds: of processors that it took, by stage; nothing of engines that infer people
            together.
    """

    draws: Mapping[str, Tensor]
    pareto_k: Tensor | None = None
    log_evidence: Tensor | None = None
    losses: tuple[float, ...] = field(default=())
    population: Population | None = None
    effective: Tensor | None = None
    engines: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)


def narrowed(draws: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Draws ``[S, P, 1, ...]`` with eight significant bits of weights, which are most of them.

    Weights are sites of more than one number a person. The rest of their bits says nothing beside
    the spread of the posterior, and takes two thirds of a file.
    """
    return {
        name: value.bfloat16() if value.is_floating_point() and value.dim() > BATCH else value
        for name, value in draws.items()
    }


def widened(value: Tensor, like: Tensor) -> Tensor:
    """Narrowed draws of a site as its human model has them, whose parameters are like this one."""
    return value.to(like.dtype) if value.dtype is torch.bfloat16 else value


@dataclass(frozen=True)
class Job:
    """What an engine has to do: infer the implants of P people, each under the model's own prior.

    Attributes:
        human: the model of people.
        rounds: of P people.
        draws: posterior draws S of each person.
        settings: of the engine, see :attr:`Engine.settings`.
        seed: of everything random.
        screening: when to give up combinations of discrete sites; ``None`` for never.
        network: of the amortized guide, if there is one.
        report: told of progress.
        checkpoint: a file that is written now and then and continued from if it exists, and what
            identifies this run (a checkpoint of another run is refused).
        refine: gradient steps on each person's rounds that refine what a network proposes.
        workers: who does it, of engines that infer each person by themselves.
        first: number of the first of these people among all; seeds of a person depend on it.
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
    first: int = 0

    def of(self, people: range) -> Job:
        """The part of the job about some of the people."""
        if len(people) == self.rounds.num_people:
            return self
        return replace(self, rounds=self.rounds.select_people(people), first=people.start)

    def part(self, people: People) -> Job:
        """The part about some of the people, as another process can do it."""
        own = self.of(people.range)
        return replace(own, report=silent, checkpoint=None, workers=Workers())


@dataclass(frozen=True)
class Engine:
    """A way to infer implants.

    Attributes:
        name: by which users know it.
        run: does a job.
        settings: class of the engine's settings; made without arguments unless they are given.
        each_alone: whether it infers each person by themselves, so that parts of the people can be
            inferred by several processes.
        pooled_draws: of each person under the human model's own prior, from which pooling chooses.
        any_program: whether it runs human models that cannot be compiled.
        takes_network: whether it proposes by an amortized guide, if there is one.
        needs_network: whether it does nothing without.
    """

    name: str
    run: Callable[[Job], Inferred]
    settings: type
    each_alone: bool = False
    pooled_draws: int = 1000
    any_program: bool = False
    takes_network: bool = False
    needs_network: bool = False

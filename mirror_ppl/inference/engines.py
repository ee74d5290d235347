"""The ways to infer a person's implants, one interface for all.

=============  ==================================================================================
``amortized``  a trained network proposes, importance weights correct; at once
``exact``      the same without a network: adaptive importance sampling from the prior on
``svi``        variational inference, one optimization for the people at hand
``nuts``       Hamiltonian Monte Carlo; slow, to compare with on small problems
=============  ==================================================================================

All marginalize the discrete sites that perception reads exactly, and all return the same.
"""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import monotonic

import torch
from torch import Tensor

from mirror_ppl import __version__
from mirror_ppl.checkpoints import read_checkpoint, save_checkpoint
from mirror_ppl.checks import as_path, real_number, require_kind, seed_number, whole_number
from mirror_ppl.data import Demonstrations
from mirror_ppl.data.contradictions import check_world
from mirror_ppl.errors import InputError, UnknownNameError
from mirror_ppl.inference.amortized import (
    AmortizedGuide,
    guide_screening,
    require_network_of,
    sample_amortized,
)
from mirror_ppl.inference.importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.nuts import sample_nuts
from mirror_ppl.inference.population.pooling import POOLINGS, Pooling, Population
from mirror_ppl.inference.second_look import LIKELY_DRAWS, coarse, looks_twice, second_look
from mirror_ppl.inference.svi import FitOptions, fit_implants
from mirror_ppl.likelihood.tables import build_view_table, rounds_of
from mirror_ppl.likelihood.view_table_builder import Screening, ViewTableBuilder
from mirror_ppl.limits import LIMITS
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, sample_sites
from mirror_ppl.models.recorded import check_rounds
from mirror_ppl.models.weights import fingerprint
from mirror_ppl.progress import Report, silent

SECONDS_BETWEEN_CHECKPOINTS = 10.0
PEOPLE_AT_ONCE = 50
"""People whose views are in memory together; they do not depend on each other."""
REFINING_RATE = 0.02
"""Learning rate of Adam where it starts near the end."""
GUIDES = ("amortized", "exact", "svi", "nuts")
OWN_DRAWS = {"amortized": 4000, "exact": 4000, "svi": 1000, "nuts": 1000}
"""Draws of each person under the human model's own prior from which pooling chooses."""


@dataclass(frozen=True)
class Inferred:
    """What was inferred of P people.

    Attributes:
        draws: joint posterior draws by site, ``[S, P, 1, ...]``, as the human model samples them.
        pareto_k: of importance weights ``[P]``, if there are any.
        losses: negative ELBO at each step in nats, if one was optimized.
        population: that people are from, if they were pooled.
        effective: number ``[P]`` of each person's own draws that pooling leaves, if they were.
    """

    draws: Mapping[str, Tensor]
    pareto_k: Tensor | None = None
    losses: tuple[float, ...] = field(default=())
    population: Population | None = None
    effective: Tensor | None = None


@dataclass(frozen=True)
class InferenceOptions:
    """How to infer.

    Attributes:
        guide: one of ``GUIDES``.
        draws: posterior draws S of each person.
        svi: settings of ``svi``; its number of draws is not used.
        exact: settings of ``exact``.
        screening: when to give up combinations of discrete sites; ``None`` for never. That of the
            amortized guide is its own.
        pooling: ``none``, or ``partial`` to infer with the people the population that they are
            from (:mod:`mirror_ppl.inference.population.pooling`).
        refine: gradient steps of ``svi`` that start at what ``amortized`` or ``exact`` found.
        allow_contradictions: share of recorded steps, from 0 to 1, that may contradict the next
            observation.
    """

    guide: str = "exact"
    draws: int = 200
    svi: FitOptions = FitOptions()
    exact: ImportanceOptions = ImportanceOptions()
    screening: Screening | None = Screening()
    pooling: str = "none"
    refine: int = 0
    allow_contradictions: float = 0.0

    def __post_init__(self) -> None:
        if self.guide not in GUIDES:
            raise UnknownNameError.of("guide", self.guide, GUIDES)
        if self.pooling not in POOLINGS:
            raise UnknownNameError.of("pooling", self.pooling, POOLINGS)
        object.__setattr__(self, "draws", whole_number(self.draws, "draws", *LIMITS["draws"]))
        object.__setattr__(self, "refine", whole_number(self.refine, "refine", 0))
        if self.screening is not None:
            require_kind(self.screening, Screening, "screening")
        share = real_number(self.allow_contradictions, "allow_contradictions", 0, 1)
        object.__setattr__(self, "allow_contradictions", share)
        if self.refine and self.guide not in ("amortized", "exact"):
            raise InputError(f"refining starts at what amortized or exact found, not {self.guide}")


def infer(
    human: HumanModel,
    demonstrations: Demonstrations,
    options: InferenceOptions,
    seed: int,
    network: AmortizedGuide | None = None,
    report: Report = silent,
    checkpoint: tuple[Path, str] | None = None,
    population: Population | None = None,
) -> Inferred:
    """Posterior draws of the implants of P people.

    Args:
        human: the model of people.
        demonstrations: rounds of P people.
        options: how to infer.
        seed: of everything random.
        network: of the amortized guide.
        report: told of progress.
        checkpoint: a file that is written now and then and continued from if it exists, and what
            identifies this run (a checkpoint of another run is refused); not of ``nuts``. Of many
            people there are more, whose names begin alike.
        population: that the people are from, if it is known from others: their prior, then.

    Raises:
        HumanModelError: the human model breaks its contract, or cannot be fitted by this guide.
        CheckpointError: the checkpoint is damaged or of another run.
        InputError: an argument of another kind, rounds of another domain, no network of the
            amortized guide, or people are to be pooled whose population is known.
        DemonstrationsError: the rounds cannot be in the domain's world.
    """
    check_rounds(human, demonstrations)
    require_kind(options, InferenceOptions, "options")
    if options.allow_contradictions < 1:
        check_world(demonstrations, options.allow_contradictions)
    seed = seed_number(seed)
    if network is not None:
        require_network_of(human, require_kind(network, AmortizedGuide, "network"))
    if population is not None:
        require_kind(population, Population, "population")
    if checkpoint is not None:
        checkpoint = as_path(checkpoint[0], "checkpoint"), checkpoint[1]
    if options.pooling == "none" and population is None:
        return _each(human, demonstrations, options, seed, network, report, checkpoint)
    if options.pooling != "none" and population is not None:
        raise InputError(
            f"people from a known population are not pooled: pooling must be none, not "
            f"{options.pooling}"
        )
    many = replace(options, draws=max(options.draws, OWN_DRAWS[options.guide]))
    own = _each(human, demonstrations, many, seed, network, report, checkpoint)
    pooling = Pooling(human)
    if population is None:
        population = pooling.fit(own.draws, options.draws, seed, report)
    population = population.spaced(options.draws)
    pooled = pooling.pooled(own.draws, population, seed)
    return replace(own, draws=pooled.draws, population=population, effective=pooled.effective)


def _each(
    human: HumanModel,
    demonstrations: Demonstrations,
    options: InferenceOptions,
    seed: int,
    network: AmortizedGuide | None,
    report: Report,
    checkpoint: tuple[Path, str] | None,
) -> Inferred:
    """Every person under the human model's own prior."""
    if options.guide in ("amortized", "exact"):
        if options.guide == "exact":
            network = None
        elif network is None:
            raise InputError("the amortized guide needs its network, not None; see load_guide")
        found = _by_importance(human, demonstrations, options, seed, network, report, checkpoint)
        if not options.refine:
            return found
        svi = replace(options.svi, steps=options.refine, learning_rate=REFINING_RATE)
        options = replace(options, guide="svi", svi=svi, refine=0)
        if checkpoint is not None:
            checkpoint = checkpoint[0].with_name(f"{checkpoint[0].name}.refined"), checkpoint[1]
        return _in_batches(human, demonstrations, options, seed, report, checkpoint, found.draws)
    return _in_batches(human, demonstrations, options, seed, report, checkpoint)


def _in_batches(
    human: HumanModel,
    demonstrations: Demonstrations,
    options: InferenceOptions,
    seed: int,
    report: Report,
    checkpoint: tuple[Path, str] | None,
    start: Mapping[str, Tensor] | None = None,
) -> Inferred:
    """``svi`` and ``nuts``: of so many people at once that their views fit into memory.

    ``svi`` starts at draws ``[S, P, 1, ...]``, if there are any.
    """
    people, found = demonstrations.num_people, []
    files = {}
    if checkpoint is not None:
        path, run = checkpoint
        for begin in range(0, people, PEOPLE_AT_ONCE):
            files[begin] = path.with_name(f"{path.name}.{begin}") if begin else path
            if files[begin].exists():  # what cannot be continued is refused before any work
                read_checkpoint(files[begin], run)
    for begin in range(0, people, PEOPLE_AT_ONCE):
        some = range(begin, min(begin + PEOPLE_AT_ONCE, people))
        own = demonstrations.select_people(some) if len(some) < people else demonstrations
        near = None
        if start is not None:
            near = {name: value[:, some.start : some.stop] for name, value in start.items()}
        table = build_view_table(
            human,
            own,
            screening=options.screening,
            report=lambda done, begin=begin: report("views", begin + done, people, "people"),
            likely=near or _likely(human, own, options, seed + begin, report),
        )
        if options.guide == "nuts":
            drawn = sample_nuts(human, table, options.draws, seed + begin, report)
            found.append(Inferred(drawn))
            continue
        file = None if checkpoint is None else (files[begin], checkpoint[1])
        svi = replace(options.svi, draws=options.draws)
        posterior = fit_implants(human, table, svi, seed + begin, report, file, near)
        found.append(Inferred(posterior.draws, losses=posterior.losses))
    draws = {name: torch.cat([one.draws[name] for one in found], 1) for name in found[0].draws}
    losses = tuple(sum(step) for step in zip(*(one.losses for one in found), strict=True))
    return Inferred(draws, losses=losses)


def _likely(
    human: HumanModel,
    demonstrations: Demonstrations,
    options: InferenceOptions,
    seed: int,
    report: Report,
) -> Draws | None:
    """Roughly who people are, where what stands for all they may attend to hangs on that."""
    if not looks_twice(human):
        return None
    roughly = replace(options, guide="exact", draws=LIKELY_DRAWS, exact=coarse(options.exact))
    return dict(_by_importance(human, demonstrations, roughly, seed, None, report, None).draws)


def _by_importance(
    human: HumanModel,
    demonstrations: Demonstrations,
    options: InferenceOptions,
    seed: int,
    network: AmortizedGuide | None,
    report: Report,
    checkpoint: tuple[Path, str] | None,
) -> Inferred:
    screening = options.screening if network is None else guide_screening()
    people = demonstrations.num_people
    done = _People() if checkpoint is None else _People.restored(*checkpoint)
    saved = monotonic()
    with torch.random.fork_rng(devices=[]):
        for person in range(len(done), people):
            report("infer", person, people, "people")
            builder, rounds = (
                ViewTableBuilder(human, screening),
                list(rounds_of(demonstrations, person)),
            )
            for one_round in rounds:
                builder.add(*one_round)
            # Whatever the number of draws that others took.
            torch.manual_seed((seed + 1) * 1_000_003 + person)
            if network is None:
                first = coarse(options.exact) if looks_twice(human) else options.exact
                found = sample_importance(human, builder.table(), first)
            else:
                found = sample_amortized(human, network, builder)
            if looks_twice(human):
                builder, found = second_look(
                    human, rounds, screening, options.exact, builder, found
                )
            done.draws.append(found.sample(options.draws, builder.grid))
            done.pareto_k.append(found.pareto_k)
            if checkpoint is not None and monotonic() - saved > SECONDS_BETWEEN_CHECKPOINTS:
                done.save(*checkpoint)
                saved = monotonic()
        order = sample_sites(human, 1)
    report("infer", people, people, "people")
    # Site after site, so that draws of pooled people, which are many, are not in memory twice.
    draws = {name: torch.cat([own.pop(name) for own in done.draws], 1) for name in order}
    return Inferred(draws, torch.tensor(done.pareto_k))


@dataclass(frozen=True)
class _People:
    """Those who are done."""

    draws: list[Draws] = field(default_factory=list)
    pareto_k: list[float] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.draws)

    def save(self, path: Path, run: str) -> None:
        save_checkpoint(path, run, vars(self))

    @classmethod
    def restored(cls, path: Path, run: str) -> _People:
        if not path.exists():
            return cls()
        content = read_checkpoint(path, run)
        return cls(content["draws"], content["pareto_k"])


def run_identity(human: HumanModel, network: AmortizedGuide | None, what: Sequence[object]) -> str:
    """What results belong to, as a hash: model with its source, network, and options and so on."""
    kinds = [kind for kind in type(human).__mro__ if issubclass(kind, HumanModel)]
    source = [(kind.__qualname__, _source(kind)) for kind in kinds]
    weights = [fingerprint(human), None if network is None else fingerprint(network)]
    description = [weights, source, __version__, [str(part) for part in what]]
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


def _source(kind: type) -> str:
    """The whole file of a class, which may lean on anything in it."""
    try:
        return Path(inspect.getfile(kind)).read_text()
    except (OSError, TypeError):  # a class made in a notebook has no file
        return kind.__qualname__

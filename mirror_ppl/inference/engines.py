"""Registry of the engines, and ``infer``, which runs any of them.

All engines target the posterior of the human program, and return joint draws of all its sites.
Those that compile the program sum out the sites that perception reads.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.checks import as_path, real_number, require_kind, seed_number, whole_number
from mirror_ppl.data import Demonstrations
from mirror_ppl.data.contradictions import check_world
from mirror_ppl.errors import InputError, RuledOutError, UnknownNameError
from mirror_ppl.inference import amortized, automatic, importance, nuts, svi
from mirror_ppl.inference.amortized_guide import AmortizedGuide, require_network_of
from mirror_ppl.inference.engine import Engine, Inferred, Job, narrowed, widened
from mirror_ppl.inference.names import current_name
from mirror_ppl.inference.population.pooling import POOLINGS, Pooling, Population
from mirror_ppl.inference.workers import Workers, parts_of
from mirror_ppl.likelihood.agreement import said_of_made_up_rounds
from mirror_ppl.likelihood.combinations import require_unread
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.limits import LIMITS
from mirror_ppl.models.human import HumanModel, has_own_program, require_standard_program
from mirror_ppl.models.measured import require_measurable
from mirror_ppl.models.recorded import check_rounds
from mirror_ppl.models.weights import fingerprint
from mirror_ppl.progress import Report, silent
from mirror_ppl.timing import add_seconds, clocked, stage
from mirror_ppl.user_code import source_of
from mirror_ppl.version import __version__

ENGINES: Mapping[str, Engine] = {
    engine.name: engine
    for engine in (
        automatic.ENGINE,
        importance.ENGINE,
        amortized.ENGINE,
        svi.ENGINE,
        nuts.ENGINE,
    )
}
"""The registry; a new engine is a file of its own and its name here."""


WEIGHED = ("pareto_k", "log_evidence", "evidence_error")
"""Fields of :class:`Inferred` that importance weights give."""


def engine_name(name: str, frames: int = 1) -> str:
    """Current name of an engine, which may be given by its former name.

    Args:
        name: current or former name.
        frames: calls between the user's code and this function, for the warning's location.

    Raises:
        UnknownNameError: there is no such engine.
    """
    name, note = current_name(name)
    if note is not None:
        warnings.warn(f"the engine {note}", FutureWarning, stacklevel=2 + frames)
    if name not in ENGINES:
        raise UnknownNameError.of("engine", name, ENGINES)
    return name


@dataclass(frozen=True)
class InferenceOptions:
    """Settings of inference.

    Attributes:
        engine: one of ``ENGINES``.
        draws: number of posterior draws S of each person.
        settings: settings of the engine, such as
            :class:`~mirror_ppl.inference.ImportanceOptions`; by default its own.
        screening: when to drop combinations of what perception reads and to merge moments;
            ``None`` for never. With a network it has no effect, as the amortized guide has its own.
        pooling: ``none``, or ``partial`` to infer the population together with the people
            (:mod:`mirror_ppl.inference.population.pooling`).
        refine: gradient steps on each person's rounds that refine the network's proposal.
        allow_contradictions: share of recorded steps, from 0 to 1, that may contradict the next
            observation.
    """

    engine: str = "auto"
    draws: int = 200
    settings: Any = None
    screening: Screening | None = Screening()
    pooling: str = "none"
    refine: int = 0
    allow_contradictions: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "engine", engine_name(self.engine, 2))
        engine = ENGINES[self.engine]
        if self.settings is None:
            object.__setattr__(self, "settings", engine.settings())
        require_kind(self.settings, engine.settings, "settings")
        if self.pooling not in POOLINGS:
            raise UnknownNameError.of("pooling", self.pooling, POOLINGS)
        object.__setattr__(self, "draws", whole_number(self.draws, "draws", *LIMITS["draws"]))
        object.__setattr__(self, "refine", whole_number(self.refine, "refine", 0))
        if self.screening is not None:
            require_kind(self.screening, Screening, "screening")
        share = real_number(self.allow_contradictions, "allow_contradictions", 0, 1)
        object.__setattr__(self, "allow_contradictions", share)
        if self.refine and not engine.takes_network:
            names = " and ".join(name for name, one in ENGINES.items() if one.takes_network)
            raise InputError(f"refining is for the engines {names}, not {self.engine}")


def infer(  # noqa: PLR0913 - everything that inference can depend on
    human: HumanModel,
    demonstrations: Demonstrations,
    options: InferenceOptions,
    seed: int,
    network: AmortizedGuide | None = None,
    report: Report = silent,
    checkpoint: tuple[Path, str] | None = None,
    population: Population | None = None,
    workers: Workers = Workers(),  # noqa: B008 - frozen
    checked: bool = False,
) -> Inferred:
    """Posterior draws of the implants of P people.

    Args:
        human: the model of people.
        demonstrations: rounds of P people.
        options: settings.
        seed: seed of all random draws.
        network: network of the amortized guide, for the engines that take one.
        report: called with progress.
        checkpoint: a file that is written during the run and resumed from if it exists, and the
            identity of this run (a checkpoint of another run is refused); not used by ``nuts``. For
            many people there are several, with the same prefix. Engines that infer each person
            separately keep each of them in a folder, and leave those of other runs alone.
        population: a population estimated from other people, to be the prior of these.
        workers: processes for engines that infer each person separately.
        checked: True if :func:`check_contract` was called already.

    Raises:
        HumanModelError: the human model breaks its contract, or cannot be fitted by this engine.
        CheckpointError: the checkpoint is damaged or of another run.
        InputError: an argument of another type, rounds of another domain, no network for the
            amortized guide, or pooling is requested although a population is given.
        DemonstrationsError: the rounds are impossible in the domain's world.
    """
    check_rounds(human, demonstrations)
    if not checked:
        check_contract(human)
    require_kind(options, InferenceOptions, "options")
    if options.allow_contradictions < 1:
        check_world(demonstrations, options.allow_contradictions)
    seed = seed_number(seed)
    if network is not None:
        require_network_of(human, require_kind(network, AmortizedGuide, "network"))
    if population is not None:
        require_kind(population, Population, "population")
    workers = replace(workers, report=report)
    if checkpoint is not None:
        checkpoint = as_path(checkpoint[0], "checkpoint"), checkpoint[1]
        workers = replace(workers, folder=parts_of(checkpoint[0]))
    engine = ENGINES[options.engine]
    if demonstrations.measurements:
        require_measurable(human, demonstrations)
        if not has_own_program(human):
            require_unread(human, demonstrations.measurements)
        own = options.pooling == "none" and population is None
        if engine.needs_network or options.refine or not own:
            raise InputError(
                f"{', '.join(demonstrations.measurements)} of people was measured, which the "
                "engine amortized, refining and pooling cannot take into account: use another "
                "engine, each person by themselves, unrefined"
            )
    job = Job(
        human,
        demonstrations,
        options.draws,
        options.settings,
        seed,
        options.screening,
        network if engine.takes_network else None,
        report,
        checkpoint,
        options.refine,
        workers,
    )
    if options.pooling == "none" and population is None:
        return _each(engine, job)
    if options.pooling != "none" and population is not None:
        raise InputError(
            f"people from a known population are not pooled: pooling must be none, not "
            f"{options.pooling}"
        )
    many = replace(job, draws=max(options.draws, engine.pooled_draws))
    own = _each(engine, many)
    pooling = Pooling(human)
    if population is None:
        population = pooling.fit(own.draws, options.draws, seed, report)
    population = population.spaced(options.draws)
    pooled = pooling.pooled(own.draws, population, seed)
    # The evidence under the population's prior is not estimated.
    return replace(
        own,
        draws=pooled.draws,
        log_evidence=None,
        evidence_error=None,
        combinations=(),
        population=population,
        effective=pooled.effective,
    )


def _each(engine: Engine, job: Job) -> Inferred:
    """Infer each person under the human model's own prior."""
    if not engine.any_program:
        require_standard_program(job.human, f"be inferred by the engine {engine.name}")
    if job.network is None and (engine.needs_network or job.refine):
        what = "refining" if job.refine else f"the engine {engine.name}"
        raise InputError(
            f"{what} needs its network, not None; see load_guide, and train --what guide for one "
            "of this human model"
        )
    if engine.each_alone:
        return _one_by_one(engine, job)
    found = engine.run(job)
    found = replace(found, engines=(engine.name,) * job.rounds.num_people)
    like = next(job.human.parameters())
    draws = {name: widened(value, like) for name, value in narrowed(found.draws).items()}
    return replace(found, draws=draws)


def _one_by_one(engine: Engine, job: Job) -> Inferred:
    """Infer people one by one, with an engine that infers each person separately."""
    identity = "" if job.checkpoint is None else job.checkpoint[1]
    parts = job.workers.run(
        "infer", job.rounds.num_people, partial(_infer_person, engine), job.alone, identity
    )
    like = next(job.human.parameters())
    drawn = [part["draws"] for part in parts]
    draws = {name: _joined(drawn, name, like) for name in list(drawn[0])}
    seconds: dict[str, float] = {}
    for part in parts:
        add_seconds(seconds, part["seconds"])
    pareto_k, log_evidence, evidence_error = (
        torch.cat([part[name] for part in parts]) for name in WEIGHED
    )
    return Inferred(
        draws,
        pareto_k,
        log_evidence,
        evidence_error,
        tuple(one for part in parts for one in part["combinations"]),
        engines=tuple(name for part in parts for name in part["engines"]),
        seconds=seconds,
    )


def _joined(parts: Sequence[dict[str, Tensor]], name: str, like: Tensor) -> Tensor:
    """Join and widen the draws of a site, which the parts give up one by one to save memory."""
    number, _, *rest = parts[0][name].shape
    people = sum(part[name].shape[1] for part in parts)
    whole = widened(parts[0][name][:0], like).new_empty(number, people, *rest)
    begin = 0
    for part in parts:
        own = part.pop(name)
        whole[:, begin : begin + own.shape[1]] = own
        begin += own.shape[1]
    return whole


def _infer_person(engine: Engine, job: Job) -> dict[str, Any]:
    with clocked() as seconds, stage("infer"):
        try:
            found = engine.run(job)
        except RuledOutError as error:
            (person,) = job.rounds.people
            raise RuledOutError(f"{person}: {error}") from error
    return {
        "draws": narrowed(found.draws),
        **{name: getattr(found, name) for name in WEIGHED},
        "combinations": list(found.combinations),
        "engines": list(found.engines) or [engine.name],
        "seconds": seconds,
    }


FORMAT = 7
"""Version of stored runs; raised whenever they change, so that older runs are not resumed."""


def run_identity(human: HumanModel, network: AmortizedGuide | None, what: Sequence[object]) -> str:
    """Hash of everything results depend on: model with its source, network, options and so on."""
    kinds = [kind for kind in type(human).__mro__ if issubclass(kind, HumanModel)]
    source = [(kind.__qualname__, source_of(kind)) for kind in kinds]
    weights = [fingerprint(human), None if network is None else fingerprint(network)]
    try:  # changes in code that the model imports show in its densities
        said = said_of_made_up_rounds(human)
    except Exception:
        if not has_own_program(human):
            raise
        said = []  # a custom program may need more than made-up rounds have
    record = human.domain.record
    own = [human.likelihood_power, record.consistency, record.value_error, *map(str, what)]
    description = [weights, source, said, __version__, FORMAT, own]
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()

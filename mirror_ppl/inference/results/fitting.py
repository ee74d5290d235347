"""Fitting: from recordings to every person's posterior, predictions and a summary."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mirror_ppl.checks import as_path, require_kind, seed_number, whole_number
from mirror_ppl.data import Demonstrations
from mirror_ppl.data.contradictions import check_world
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import DemonstrationsError
from mirror_ppl.inference.amortized_guide import AmortizedGuide
from mirror_ppl.inference.engines import InferenceOptions, Inferred, infer, run_identity
from mirror_ppl.inference.population.pooling import Pooling, Population
from mirror_ppl.inference.results.criticism import models_of
from mirror_ppl.inference.results.description import Description, describe
from mirror_ppl.inference.results.prior_conflict import prior_conflicts
from mirror_ppl.inference.results.summary import summarize, summarize_newcomer
from mirror_ppl.inference.workers import Workers, parts_of
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.limits import return_memory
from mirror_ppl.models.dependencies import ADDS_TO_ROUNDS, dependencies
from mirror_ppl.models.family import KIND, OneOfKinds
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import in_units
from mirror_ppl.models.prior import sites_of_several_numbers
from mirror_ppl.models.recorded import check_rounds
from mirror_ppl.models.simulation import OWN_HUMAN_MODEL, OWN_SIGHT
from mirror_ppl.models.weights import fingerprint
from mirror_ppl.models.world_knowledge import fit_world
from mirror_ppl.progress import Report, silent
from mirror_ppl.timing import add_seconds
from mirror_ppl.user_code import is_of_package, is_own_method
from mirror_ppl.version import __version__

if TYPE_CHECKING:
    import arviz as az

TRAIN_ROUNDS, TEST_ROUNDS = 20, range(30, 36)
"""Rounds 1-20 train and 31-36 test (21-30 are for validation, 37-40 spare), counted from 0."""


@dataclass(frozen=True)
class Fit:
    """Results of fitting P people.

    Attributes:
        human: the human model.
        train: training rounds.
        posterior: draws and diagnostics.
        data: the posterior and predictions as ArviZ ``InferenceData``.
        summary: content of ``summary.json``.
        seconds: processor time by stage.
    """

    human: HumanModel
    train: Demonstrations
    posterior: Inferred
    data: az.InferenceData
    summary: dict[str, Any]
    seconds: dict[str, float]


def split_rounds(
    demonstrations: Demonstrations, train_rounds: int | None = None
) -> tuple[Demonstrations, Demonstrations | None]:
    """Split recordings into training and held-out rounds.

    Recordings of 36 rounds or more are split as in the supplement: 20 to train, rounds 31 to 36 to
    test. Shorter ones are split three quarters to one quarter.

    Args:
        demonstrations: all rounds.
        train_rounds: number of training rounds, from the first one on; 0 gives the prior. If they
            reach into the test rounds, all later rounds are held out.

    Returns:
        Training rounds, and the held-out ones or ``None`` if none are left.

    Raises:
        InputError: these are no demonstrations, or the number is invalid.
        DemonstrationsError: there are fewer rounds than requested.
    """
    require_kind(demonstrations, Demonstrations, "demonstrations")
    rounds = int(demonstrations.round_counts.max())
    paper = rounds >= TEST_ROUNDS.stop
    if train_rounds is None:
        train_rounds = TRAIN_ROUNDS if paper else max(1, -(-3 * rounds // 4))
    train_rounds = whole_number(train_rounds, "train_rounds")
    if rounds == 0 and train_rounds:
        raise DemonstrationsError(
            "the recordings hold no rounds, so that the posterior is the prior; ask for it by 0 "
            "training rounds"
        )
    if not 0 <= train_rounds <= rounds:
        raise DemonstrationsError(f"cannot train on {train_rounds} of {rounds} rounds")
    paper = paper and train_rounds <= TEST_ROUNDS.start
    test = list(TEST_ROUNDS if paper else range(train_rounds, rounds))
    train = demonstrations.select_rounds(list(range(train_rounds)))
    return train, demonstrations.select_rounds(test) if test else None


def fit_people(  # noqa: PLR0913 - everything a fit can depend on
    human: HumanModel,
    demonstrations: Demonstrations,
    options: InferenceOptions = InferenceOptions(),  # noqa: B008 - frozen
    seed: int = 0,
    train_rounds: int | None = None,
    report: Report = silent,
    checkpoint: Path | None = None,
    network: AmortizedGuide | None = None,
    population: Population | None = None,
    workers: Workers = Workers(),  # noqa: B008 - frozen
    explore: int = 0,
    every_draw: bool = False,
    checked: bool = False,
) -> Fit:
    """Infer the implants of all people in recordings, and predict their held-out actions.

    Args:
        human: the model of people.
        demonstrations: rounds of P people.
        options: settings of inference.
        seed: seed of all random draws.
        train_rounds: see :func:`split_rounds`.
        report: called with progress.
        checkpoint: file to resume from; written during the run and never removed. Results of single
            people are stored in a folder of that name with ``.parts``.
        network: network for the engines that take one.
        population: a population estimated from other people, to be the prior of these.
        workers: processes to use; its ``report`` and ``folder`` are replaced.
        explore: rounds that are simulated in each scenario, to find the most informative one.
        every_draw: keep predictions of held-out actions under every draw, and all of the prior.
        checked: True if :func:`check_contract` was called already.

    Raises:
        InputError: an argument of another type, or rounds of another domain.
        DemonstrationsError: too few rounds, or rounds that are impossible in the domain's world
            (see :func:`mirror_ppl.data.contradictions.check_world`).
        HumanModelError: the human model breaks its contract, or cannot be fitted by this engine.
        CheckpointError: the checkpoint is damaged or of another run.
    """
    check_rounds(human, demonstrations)
    if not checked:
        check_contract(human)
    require_kind(options, InferenceOptions, "options")
    contradictions = check_world(demonstrations, options.allow_contradictions)
    seed = seed_number(seed)
    checkpoint = None if checkpoint is None else as_path(checkpoint, "checkpoint")
    train, test = split_rounds(demonstrations, train_rounds)
    fit_world(human, train)
    workers, run, identity = replace(workers, report=report), None, ""
    if checkpoint is not None:
        workers = replace(workers, folder=parts_of(checkpoint))
        which = [options, population is None, _recorded(train), seed]
        identity = run_identity(human, network, which)
        run = checkpoint, identity
    # All rounds were checked together.
    anyway = replace(options, allow_contradictions=1.0)
    posterior = infer(human, train, anyway, seed, network, report, run, population, workers, True)
    return_memory()
    how = Description(human, seed, explore, posterior.population, every_draw)
    if checkpoint is not None and test is not None:
        identity += f"{_recorded(test)} {explore} {every_draw}"
    described = describe(
        how, train, test, posterior.draws, posterior.combinations, workers, identity
    )
    # Results are on the CPU.
    learned = train
    train, test = train.to("cpu"), None if test is None else test.to("cpu")
    drawn = {name: value.cpu() for name, value in posterior.draws.items()}

    from mirror_ppl.inference.results.export import (
        add_check,
        add_identifiability,
        to_inference_data,
    )
    from mirror_ppl.inference.results.population_file import add_population

    pooling = options.pooling if population is None else "known population"
    attributes = _attributes(human, train, options, pooling, seed)
    predicted, unidentified = described.predictions, described.identifiability
    data = to_inference_data(train, test, drawn, described.prior, predicted, attributes)
    newcomer = {}
    if posterior.population is not None:
        newcomer = add_population(data, Pooling(human), posterior.population, attributes, seed)
        newcomer = {"newcomer": summarize_newcomer(newcomer, human.value_names)}
    if unidentified is not None:
        add_identifiability(data, unidentified, attributes)
    drawn = in_units(get_domain(train.domain), drawn)
    found = summarize(drawn, train, predicted.scores, human.value_names)
    scenarios = get_domain(train.domain).scenarios
    for number, (person, engine) in enumerate(zip(found, posterior.engines, strict=True)):
        person["engine"] = engine
        if posterior.pareto_k is not None:
            value = float(posterior.pareto_k[number])
            person["pareto_k"] = value if isfinite(value) else None
        if posterior.log_evidence is not None and posterior.evidence_error is not None:
            value = float(posterior.log_evidence[number])
            error = float(posterior.evidence_error[number])
            known = isfinite(value) and human.likelihood_power == 1
            person["log_evidence"] = round(value, 3) if known else None
            person["evidence_error"] = round(error, 3) if known else None
        if posterior.effective is not None:
            person["effective_draws"] = round(float(posterior.effective[number]), 1)
        person["check"] = predicted.checks[number]
        if isinstance(human, OneOfKinds):
            person["check"]["models"] = models_of(human, posterior.draws[KIND][:, number])
        if unidentified is not None:
            person["identifiability"] = unidentified.of(number, scenarios)
    add_check(data, found, attributes)
    seconds = dict(posterior.seconds)
    add_seconds(seconds, described.seconds)
    summary = attributes | {
        "value_error": human.domain.record.value_error,
        "options": asdict(options),
        "contradictions": contradictions.as_data(),
        # Of pooled people a population is the prior of most sites.
        "prior_conflicts": None
        if pooling != "none"
        else prior_conflicts(human, posterior.draws, learned.round_counts, seed),
        "several_numbers": sites_of_several_numbers(human),
        "people": found,
    }
    summary |= newcomer
    return_memory()
    return Fit(human, learned, posterior, data, summary, seconds)


def _attributes(
    human: HumanModel, train: Demonstrations, options: InferenceOptions, pooling: str, seed: int
) -> dict[str, str | int | float]:
    """Attributes of ``posterior.nc`` and ``summary.json``."""
    domain = get_domain(train.domain)
    own = {
        "domain": domain.name,
        "domain_version": domain.version,
        "setting": train.setting,
        "human_model": type(human).__name__,
        "likelihood_power": human.likelihood_power,
        "value_error": f"{human.domain.record.value_error:g}",
        "self_model": fingerprint(human.self_model),
        "guide": options.engine,
        "refined": options.refine,
        "pooling": pooling,
        "version": __version__,
        "seed": seed,
    }
    if dependencies(human).adds_to_rounds:
        own[ADDS_TO_ROUNDS] = 1
    if not is_of_package(human):
        own[OWN_HUMAN_MODEL] = 1
        methods = [name for name in ("sees", "perceive") if is_own_method(human, name)]
        own |= {OWN_SIGHT: methods[0]} if methods else {}
    return own | {f"recorded_{name}": value for name, value in train.provenance.items()}


def _recorded(train: Demonstrations) -> str:
    """Hash of the recordings."""
    digest = hashlib.sha256()
    for name, value in sorted(train.variables().items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().numpy().tobytes())
    return digest.hexdigest()

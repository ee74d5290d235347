"""The main interface: infer people from recordings, plot them, and plan messages to them.

Its names are those of the package itself, as in ``mirror_ppl.infer``. Commands call them, too.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import fields
from pathlib import Path
from typing import Any

from mirror_ppl.checks import require_kind, seed_number, whole_number
from mirror_ppl.communication.communicator import NOT_EXPLAINED
from mirror_ppl.communication.communicator import Communicator as PlannedCommunicator
from mirror_ppl.communication.companion import Companion
from mirror_ppl.communication.person import Person
from mirror_ppl.communication.planners import PlannerOptions, planner_of
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.data import Demonstrations, asset_path, load_demonstrations
from mirror_ppl.data.recorder import Recorder
from mirror_ppl.devices import usable_device
from mirror_ppl.domains import DOMAINS as worlds
from mirror_ppl.domains import World, add_domain, domain_of, get_domain, require_known
from mirror_ppl.errors import InputError, PriorConflict, UnexplainedPerson, UnreliableWeights
from mirror_ppl.fitted import Fit, doubtful_people, one_of
from mirror_ppl.inference.engines import ENGINES, InferenceOptions, engine_name
from mirror_ppl.inference.population.pooling import Pooling
from mirror_ppl.inference.results import fitting
from mirror_ppl.inference.results.criticism import UNEXPLAINED, warning_of
from mirror_ppl.inference.results.population_file import load_population
from mirror_ppl.inference.results.posterior_file import PosteriorFile, load_posterior
from mirror_ppl.inference.results.prior_conflict import conflict_line
from mirror_ppl.inference.weighted import HIGH_PARETO_K
from mirror_ppl.inference.workers import Workers
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.limits import LIMITS
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import (
    checked_base,
    load_human_model,
)
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.models.world_knowledge import WorldKnowledge
from mirror_ppl.people import populations_of
from mirror_ppl.progress import Report, Stages, silent
from mirror_ppl.training.guide_file import network_for

__all__ = [
    "Communicator",
    "Companion",
    "Fit",
    "HumanModel",
    "Recorder",
    "RoundSoFar",
    "World",
    "add_domain",
    "infer",
    "load_recordings",
    "worlds",
]

KEPT = ("means", "draws")
"""Forms in which predictions may be kept."""
SHIPPED = "the people that ship"
"""Recordings of :func:`infer` unless others are given."""


class Communicator(PlannedCommunicator):
    """Plans messages for one person of a fit.

    Args:
        fit: what :func:`infer` returned, or the path of a saved ``posterior.nc``.
        person: id; the only one unless named.
        planner: ``mirror`` (reward, in the domain's simulator), ``mirror-self-model`` (reward, in
            the robot's learned model of the world) or ``mirror-kl`` (beliefs near the robot's).
        draws: posterior draws to plan with; 20 to 100 are enough.
        seed: of everything random; the same seed and round give the same decision.
        human: human model of a saved posterior, if it is your own; as for :func:`infer`.
        self_model: the robot's networks of a saved posterior; those that ship unless given.
        plan_anyway: True to plan messages even if the model check's verdict on the person is
            ``unexplained``; else such a person gets none.
        settings: of the planner, see :class:`PlannerOptions`; those of the domain unless given.

    Raises:
        InputError: the fit is of several people and none is named, or an argument is of another
            kind.
        PosteriorError: the file is missing or damaged, or of another human model or self-model.
        UnknownNameError: there is no such person, planner or setting.

    Warns:
        UnexplainedPerson: the model check's verdict on the person is ``unexplained``.
    """

    def __init__(
        self,
        fit: Fit | str | Path,
        person: str | None = None,
        *,
        planner: str = "mirror",
        draws: int = 64,
        seed: int = 0,
        human: HumanModel | type[HumanModel] | str | None = None,
        self_model: SelfModel | str | Path | None = None,
        plan_anyway: bool = False,
        **settings: Any,
    ) -> None:
        if isinstance(fit, str | Path):
            saved = load_posterior(Path(fit))
            own = one_of(saved.people, person, str(fit))
            listener = _saved_person(saved, own, draws, human, self_model)
            verdict = saved.verdicts.get(own)
        else:
            if not (human is None and self_model is None):
                raise InputError("human and self_model are for a saved posterior; a fit has both")
            fitted = require_kind(fit, Fit, "fit").person(person)
            own, verdict = fitted.name, fitted.summary["check"]["verdict"]
            listener = fitted.listener(draws)
        if unexplained := verdict == UNEXPLAINED:
            said = warning_of([own], "plan_anyway=True", plan_anyway)
            warnings.warn(said, UnexplainedPerson, stacklevel=2)
        known = [field.name for field in fields(PlannerOptions)]
        for name in settings:
            require_known(name, "setting", known)
        options = PlannerOptions.of(listener.human.domain.name, **settings)
        made = planner_of(planner, listener, options, seed_number(seed))
        super().__init__(
            made.person,
            made.objective,
            made.search,
            made.min_standard_errors,
            made.seed,
            NOT_EXPLAINED if unexplained and not plan_anyway else "",
        )


def load_recordings(
    path: str | Path | None = None,
    *,
    domain: str | None = None,
    setting: str | None = None,
    population: str | None = None,
) -> Demonstrations:
    """Read recordings: a file in the documented format, or simulated people that ship.

    Args:
        path: the file.
        domain: of the shipped recordings, ``driving`` unless given. That of a file is checked; a
            world of your own is loaded by ``path/to/file.py:Class``, whose code is run.
        setting: of the shipped recordings, the one in which people see less unless given. That of a
            file is checked.
        population: of the shipped recordings, ``paper`` unless given.

    Raises:
        InputError: the file is of another domain or setting, or a population is given with it.
        DemonstrationsError: the file is missing or damaged, or breaks the format.
        UnknownNameError: there is no such domain, setting or population.
    """
    domain = None if domain is None else get_domain(domain).name
    if path is not None:
        recorded = load_demonstrations(path)
        for name, given in (("domain", domain), ("setting", setting)):
            own = getattr(recorded, name)
            if given not in (None, own):
                raise InputError(f"{name} is {given}, but the recordings are of {own}")
        if population is not None:
            raise InputError("population is of the shipped recordings, not of a file")
        return recorded
    domain = "driving" if domain is None else domain
    settings = get_domain(domain).settings
    setting = require_known(setting or settings[-1], "setting", settings, domain)
    populations = populations_of(domain)
    population = require_known(population or "paper", "population", populations, domain)
    if domain not in worlds:
        raise InputError(f"no recordings of {domain} ship; name a file of them (--demos)")
    return load_demonstrations(asset_path(f"{domain}_{setting}_{population}.nc"))


def infer(  # noqa: PLR0913 - everything a fit can depend on
    recordings: Demonstrations | str | Path = SHIPPED,
    *,
    domain: World | type[World] | str | None = None,
    human: HumanModel | type[HumanModel] | str | None = None,
    engine: str = "auto",
    pooling: str = "none",
    seed: int = 0,
    draws: int = 200,
    train_rounds: int | None = None,
    settings: Any = None,
    refine: int = 0,
    explore: int = 8,
    allow_contradictions: float = 0.0,
    prior_from: str | Path | None = None,
    guide_file: str | Path | None = None,
    self_model: SelfModel | str | Path | None = None,
    device: str = "cpu",
    jobs: int | None = 1,
    scheduler: str | None = None,
    keep: str = "means",
    report: Report | None = None,
    checkpoint: str | Path | None = None,
) -> Fit:
    """Infer what people see and how they decide.

    Args:
        recordings: rounds of P people, or a file of them; simulated people that ship unless given
            (people are chosen by ``recordings.select_people``).
        domain: the world of the recordings, if it is your own: an object, its class, or
            ``path/to/file.py:Class``, whose code is run.
        human: the human model: an object or a class, one of the package's names (such as
            ``one-radius``) or ``path/to/file.py:Class``; the package's own for the domain unless
            given.
        engine: one of ``mirror_ppl.inference.engines.ENGINES``; ``auto`` is the amortized guide
            where there is a network of this human model and its draws are reliable, and
            ``importance`` otherwise; each person's part of the summary names the engine.
        pooling: ``none``, or ``partial`` to infer the population that the people are from, too.
        seed: of everything random: the same seed gives the same fit.
        draws: posterior draws S of each person.
        train_rounds: how many rounds of each person to learn from; see
            :func:`mirror_ppl.inference.results.fitting.split_rounds`.
        settings: of the engine, such as ``{"steps": 500}``; its own unless given.
        refine: gradient steps on each person's rounds that refine a network's proposal.
        explore: rounds that the model plays in each scenario, to find the most informative one; 0
            for none.
        allow_contradictions: share of steps, from 0 to 1, that may contradict the next observation.
        prior_from: a file of a fit with ``pooling="partial"``, whose population is the prior.
        guide_file: network of ``auto`` and ``amortized``; the one that ships unless given.
        self_model: the robot's networks, or a file of them; those that ship unless given. Not with
            a human model that is an object, which has its own.
        device: where to compute: cpu, cuda or cuda:0.
        jobs: processes that share the people; -1 for one per core, None to choose by the work.
            Results do not depend on it. The engines svi and nuts use one process for all people.
        scheduler: address of a Dask cluster that does the work instead, such as
            ``tcp://host:8786``.
        keep: of predicted held-out actions, ``means`` over draws or ``draws``; with ``draws`` also
            all sites of the prior, not only those that are one number a person.
        report: called with the progress; shown on stderr, if that is a terminal, unless given.
        checkpoint: file to continue from; written on the way, and kept.

    Warns:
        UnreadSite: nothing in a model of yours seems to depend on some sites of its prior.
        PriorConflict: the prior of a site is at odds with most of the people.
        UnreliableWeights: importance weights of a person are not reliable.

    Raises:
        InputError: an argument of another kind.
        MirrorError: the fit is not possible; its kinds are those of
            :func:`mirror_ppl.inference.results.fitting.fit_people`.
    """
    if recordings is None:
        raise InputError("recordings are None; leave them out to fit the people that ship")
    world = None if domain is None else domain_of(domain).name
    if isinstance(recordings, str | Path):
        path = None if recordings == SHIPPED else recordings
        recordings = load_recordings(path, domain=world)
    elif not isinstance(recordings, Demonstrations):
        raise InputError(
            f"recordings are of the class {type(recordings).__name__}, expected Demonstrations or "
            "the path of a file; mirror_ppl.data.from_dataset makes them of an xarray.Dataset"
        )
    if world not in (None, recordings.domain):
        raise InputError(f"domain is {world}, but the recordings are of {recordings.domain}")
    where = usable_device(device)
    engine = engine_name(engine)
    if isinstance(settings, Mapping):
        kind = ENGINES[engine].settings
        known = [field.name for field in fields(kind)]
        settings = kind(
            **{require_known(name, "setting", known): settings[name] for name in settings}
        )
    options = InferenceOptions(
        engine,
        draws,
        settings,
        pooling=pooling,
        refine=refine,
        allow_contradictions=allow_contradictions,
    )
    explore = whole_number(explore, "explore", *LIMITS["explore"])
    if guide_file is not None and not ENGINES[options.engine].takes_network:
        raise InputError("guide_file is for the engines auto and amortized")
    model = _human(human, self_model, recordings.domain).to(where)
    check_contract(model)
    network = network_for(options.engine, None if guide_file is None else Path(guide_file), model)
    population = None
    if prior_from is not None:
        if pooling != "none":
            raise InputError("prior_from is for people who are not pooled; leave out pooling")
        population = load_population(Path(prior_from), Pooling(model), recordings.setting)
    workers = Workers(None if jobs is None else whole_number(jobs, "jobs", -1), scheduler)
    with Stages() if report is None and sys.stderr.isatty() else nullcontext() as stages:
        report = report or (stages.report if stages is not None else silent)
        found = fitting.fit_people(
            model,
            recordings.to(where),
            options,
            seed,
            train_rounds,
            report,
            None if checkpoint is None else Path(checkpoint),
            network,
            population,
            workers,
            explore,
            require_known(keep, "keep", KEPT) == "draws",
            checked=True,
        )
    if prior_from is not None:
        found.summary["prior_from"] = str(prior_from)
    for site, conflict in (found.summary["prior_conflicts"] or {}).items():
        warnings.warn(conflict_line(site, conflict), PriorConflict, stacklevel=2)
    if doubtful := doubtful_people(found.summary):
        warnings.warn(
            f"importance weights of {', '.join(doubtful)} are not to be relied on (Pareto k above "
            f"{HIGH_PARETO_K}): use more proposals, or another engine",
            UnreliableWeights,
            stacklevel=2,
        )
    return Fit(**vars(found))


def _saved_person(
    saved: PosteriorFile,
    person: str,
    draws: int,
    human: HumanModel | type[HumanModel] | str | None,
    self_model: SelfModel | str | Path | None,
) -> Person:
    """Make the person to plan messages for from a posterior file."""
    number = saved.people.index(person)
    domain = saved.attributes["domain"]
    if human is None:
        human = saved.own_model("human=")
    model = _human(human, self_model, domain)
    held = len(next(iter(saved.values.values())))
    chosen = saved.draws(model, min(whole_number(draws, "draws", *LIMITS["draws"]), held))
    return Person(model, {name: value[:, number : number + 1] for name, value in chosen.items()})


def _human(
    human: HumanModel | type[HumanModel] | str | None,
    self_model: SelfModel | str | Path | None,
    domain: str,
) -> HumanModel:
    """Make the human model for recordings of a domain."""
    if isinstance(human, HumanModel):
        if self_model is not None:
            raise InputError("self_model is for a human model that is to be made; this one has one")
        # What one fit learns about the world must not change the model of another.
        return deepcopy(human) if isinstance(human, WorldKnowledge) else human
    of_class = isinstance(human, type) and issubclass(human, HumanModel)
    if not (human is None or isinstance(human, str) or of_class):
        raise InputError(f"human must be a human model, its class or its name, not {human!r}")
    if not isinstance(self_model, SelfModel):
        path = shipped_weights(domain) if self_model is None else Path(self_model)
        self_model, _ = load_self_model(path, domain)
    if isinstance(human, type):
        return checked_base(human(self_model))
    return load_human_model(human, self_model)

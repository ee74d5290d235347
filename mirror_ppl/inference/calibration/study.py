"""Simulation-based calibration of posteriors: tests that ranks are uniform and intervals cover.

Implements Talts, Betancourt, Simpson, Vehtari and Gelman (*Validating Bayesian inference algorithms
with simulation-based calibration*, 2018) for human models and any inference method::

    psi_p    ~ prior                                   people drawn from the human model itself
    rounds_p ~ program(psi_p)                          their actions
    psi_p^s  ~ infer(rounds_p),   s = 1 .. S           draws from the posterior to be tested

If inference is exact, the rank of psi_p among its S draws is uniform over 0 .. S for every model.
This module simulates and infers; :mod:`mirror_ppl.inference.calibration.ranks` evaluates the ranks.

Departures from the paper: ties, of which discrete sites have many, are broken at random; uniformity
is tested, in two ways (:mod:`mirror_ppl.inference.calibration.uniformity`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
import xarray as xr
from torch import Tensor

from mirror_ppl.checks import whole_number
from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import require_known
from mirror_ppl.errors import HumanModelError, InputError
from mirror_ppl.inference.calibration.ranks import Calibration, collect, join_rounds, judge
from mirror_ppl.inference.engines import Inferred
from mirror_ppl.jobs import DatasetFormat, Runner
from mirror_ppl.likelihood.densities import correction, prior_nodes
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, sample_sites
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import fingerprint
from mirror_ppl.randomness import forked, seed_everything
from mirror_ppl.version import __version__

PRIOR_PEOPLE = 4000
"""Draws that estimate the prior's widths and entropies to a few percent."""
PEOPLE_AT_ONCE = 500
"""People drawn from the prior at once; bounds memory."""


Infer = Callable[[Demonstrations, int], Inferred]
"""Function that infers each person of recordings, given a seed for all random draws."""

Summary = Callable[[Mapping[str, Tensor]], Tensor]
"""Function from values of all sites ``[..., P, 1, ...]`` to a number ``[..., P, 1]``."""


@dataclass(frozen=True)
class CalibrationOptions:
    """Settings of a calibration.

    Attributes:
        people: number of people drawn from the prior.
        rounds: numbers of rounds to infer from, increasing; the shorter recordings are the first
            rounds of the longer ones.
        batch: people who are simulated and inferred at once; bounds memory.
        summaries: scalar functions, by name, to calibrate besides the sites without event
            dimensions. A summary that returns integers or booleans is discrete.

    Raises:
        InputError: there are no people, no rounds, or rounds that do not increase.
    """

    people: int = 500
    rounds: tuple[int, ...] = (1, 5, 20)
    batch: int = 20
    summaries: Mapping[str, Summary] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("people", "batch"):
            object.__setattr__(self, name, whole_number(getattr(self, name), name, 1))
        if not self.rounds or sorted({0, *self.rounds}) != [0, *self.rounds]:
            raise InputError(f"rounds must be positive and increase, not {self.rounds}")


@torch.no_grad()
def prior_people(human: HumanModel, people: int, generator: torch.Generator) -> Draws:
    """Draw people from the prior: values ``[P, 1, ...]`` of all sites.

    Args:
        human: the model of people.
        people: number of people P.
        generator: source of randomness.

    Raises:
        InputError: the number of people is below 1.
    """
    if people < 1:
        raise InputError(f"people must be at least 1, not {people}")
    parts = []
    for begin in range(0, people, PEOPLE_AT_ONCE):
        sites = _prior_sites(human, min(PEOPLE_AT_ONCE, people - begin), _seed(generator))
        parts.append({name: site["value"] for name, site in sites.items()})
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


@dataclass(frozen=True)
class Batch:
    """People who are simulated and inferred together.

    Attributes:
        first: number of the first person.
        people: number of people.
    """

    first: int
    people: int

    @property
    def label(self) -> str:
        """Name of the batch, for progress reports."""
        return f"people {self.first + 1} to {self.first + self.people}"


def calibrate(
    human: HumanModel,
    infer: Infer,
    options: CalibrationOptions,
    setting: str,
    seed: int,
    runner: Runner | None = None,
) -> Calibration:
    """Test posteriors on people who are drawn from the model's prior.

    Args:
        human: the model of people, from which people and rounds are drawn.
        infer: the method to test; it has to be picklable if there are several processes.
        options: settings.
        setting: name under which the rounds are recorded.
        seed: seed of all random draws; people and rounds do not depend on ``infer``.
        runner: does the work of each `Batch`; by default this process, without stored results.

    Raises:
        UnknownNameError: there is no such setting.
        InputError: ``infer`` or a summary returned invalid values.
        HumanModelError: a method has a factor, an observed site, a scale or a mask; or the model
            has a power of the likelihood.
    """
    require_known(setting, "setting", human.domain.settings, human.domain.name)
    _require_plain_program(human)
    trial = _Trial(human, options, setting, seed)
    batches = [
        Batch(first, min(options.batch, options.people - first))
        for first in range(0, options.people, options.batch)
    ]
    work = partial(_judged, trial, infer)
    outcomes = (runner or Runner()).run(batches, work, DatasetFormat())
    attributes = {
        "domain": human.domain.name,
        "domain_version": human.domain.version,
        "setting": setting,
        "human_model": type(human).__name__,
        "self_model": fingerprint(human.self_model),
        "version": __version__,
        "seed": str(seed),
    }
    judged = [outcome.result for outcome in outcomes if outcome.result is not None]
    return collect(judged, trial.prior, trial.discrete, attributes)


def _require_plain_program(human: HumanModel) -> None:
    """Refuse human models with factors and the like, which simulated people do not follow."""
    kind = type(human).__name__
    if human.likelihood_power != 1:
        raise HumanModelError(
            f"{kind}.likelihood_power is {human.likelihood_power:g}: people who are simulated do "
            "not follow a power of the likelihood; set it to 1 to calibrate an engine"
        )
    for name, node in prior_nodes(human, {}, 1, 1).items():
        if correction(node) is not None:
            raise HumanModelError(
                f'"{name}" of {kind}.prior is a factor, observed, scaled or masked: people who are '
                "drawn from the prior do not follow it; calibrate a model without it"
            )
    found = dependencies(human)
    for method, adds in (("act", found.adds_to_actions), ("round_latents", found.adds_to_latents)):
        if adds:
            raise HumanModelError(
                f"{kind}.{method} has a factor, an observed site, a scale or a mask: people who "
                "are simulated do not follow it; calibrate a model without it"
            )


def _judged(trial: _Trial, infer: Infer, batch: Batch) -> xr.Dataset:
    return trial.batch(infer, batch)


class _Trial:
    """Simulated people with known implants, batch by batch."""

    def __init__(
        self, human: HumanModel, options: CalibrationOptions, setting: str, seed: int
    ) -> None:
        self.human = human
        self.options = options
        self.setting = setting
        self.seed = seed
        sites = {
            name: site["fn"].support.is_discrete
            for name, site in _prior_sites(human, 1, seed).items()
            if site["fn"].event_dim == 0
        }
        self.scalars = _Scalars(tuple(sites), options.summaries)
        drawn = prior_people(human, PRIOR_PEOPLE, self._generator(-1))
        self.prior = self.scalars.of(drawn, (PRIOR_PEOPLE,), "the prior")
        self.discrete = [name for name in sites if sites[name]]
        for name, summary in options.summaries.items():
            self.discrete += [] if summary(drawn).is_floating_point() else [name]

    def batch(self, infer: Infer, batch: Batch) -> xr.Dataset:
        """Simulate and infer a batch, and compare with the truth after each number of rounds."""
        options, generator = self.options, self._generator(batch.first)
        rng = np.random.default_rng([self.seed, batch.first])
        implants = prior_people(self.human, batch.people, generator)
        truth = self.scalars.of(implants, (batch.people,), "the prior")
        recordings = play_rounds(self.human, implants, options.rounds[-1], self.setting, generator)
        judged = {}
        for number in options.rounds:
            inferred = infer(recordings.select_rounds(range(number)), _seed(generator))
            number_of_draws = len(next(iter(inferred.draws.values()), ()))
            source = f"infer() of {number} rounds"
            draws = self.scalars.of(inferred.draws, (number_of_draws, batch.people), source)
            pareto_k = None
            if inferred.pareto_k is not None:
                pareto_k = inferred.pareto_k.detach().double().cpu().numpy()
            judged[number] = judge(truth, draws, self.discrete, rng, pareto_k)
        return join_rounds(judged)

    def _generator(self, begin: int) -> torch.Generator:
        device = next(self.human.parameters()).device
        return torch.Generator(device).manual_seed(self.seed * 1_000_003 + begin + 1)


def _seed(generator: torch.Generator) -> int:
    return int(torch.randint(2**31, (), generator=generator, device=generator.device))


def _prior_sites(human: HumanModel, people: int, seed: int) -> dict[str, Any]:
    """Trace nodes of all sites, sampled for P people."""
    with forked():
        seed_everything(seed)
        return sample_sites(human, people)


@dataclass(frozen=True)
class _Scalars:
    """Scalars per person: sites without event dimensions, and summaries."""

    sites: tuple[str, ...]
    summaries: Mapping[str, Summary]

    def __post_init__(self) -> None:
        for name in set(self.sites) & set(self.summaries):
            raise InputError(f'the summary "{name}" has the name of a site')

    def of(
        self, draws: Mapping[str, Tensor], shape: tuple[int, ...], source: str
    ) -> dict[str, np.ndarray]:
        """Scalars by name, of this shape ``[..., P]``, from draws ``[..., P, 1, ...]``.

        Raises:
            InputError: a site is missing, of another shape or not finite.
        """
        result = {}
        for name in (*self.sites, *self.summaries):
            try:
                value = self.summaries[name](draws) if name in self.summaries else draws[name]
            except KeyError as error:
                raise InputError(f"{source}: there are no draws of {error}") from error
            if tuple(value.shape) != (*shape, 1):
                raise InputError(
                    f"{source}: {name} has shape {tuple(value.shape)}, expected {(*shape, 1)}"
                )
            if not value.isfinite().all():
                raise InputError(f"{source}: {name} has values that are not finite numbers")
            result[name] = value.detach().squeeze(-1).double().cpu().numpy()
        return result

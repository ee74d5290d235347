"""Simulation-based calibration: are posteriors as sure of people as they have a right to be?

Implements Talts, Betancourt, Simpson, Vehtari and Gelman (*Validating Bayesian inference algorithms
with simulation-based calibration*, 2018) for human models, whatever makes the posteriors::

    psi_p    ~ prior                                   people drawn from the human model itself
    rounds_p ~ program(psi_p)                          what they do
    psi_p^s  ~ infer(rounds_p),   s = 1 .. S           draws from the posterior to be tested

Where inference is right, the rank of psi_p among its S draws is uniform over 0 .. S, whatever the
model. :mod:`mirror_ppl.inference.ranks` looks at the ranks; here they are made.

Departures from the paper: ties, of which discrete sites have many, are broken at random; uniformity
is tested, in two ways (:mod:`mirror_ppl.inference.uniformity`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import xarray as xr
from torch import Tensor

from mirror_ppl import __version__
from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import require_known
from mirror_ppl.inference.guides import Inferred
from mirror_ppl.inference.prior import Draws, sample_sites
from mirror_ppl.inference.ranks import Calibration, collect, judge
from mirror_ppl.inference.simulation import play_rounds
from mirror_ppl.inference.svi import Report, silent
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.weights import fingerprint

PRIOR_PEOPLE = 4000
"""Drawn to know the prior's widths and entropies to a few percent."""
PEOPLE_AT_ONCE = 500
"""Drawn from the prior at once; bounds memory."""


Infer = Callable[[Demonstrations, int], Inferred]
"""Makes a posterior of each person of recordings; is given a seed for everything random."""

Summary = Callable[[Mapping[str, Tensor]], Tensor]
"""A number ``[..., P, 1]`` of the values of all sites, ``[..., P, 1, ...]``."""


@dataclass(frozen=True)
class CalibrationOptions:
    """Settings of a calibration.

    Attributes:
        people: number of people drawn from the prior.
        rounds: numbers of rounds to infer from, increasing; the shorter recordings are the first
            rounds of the longer ones.
        batch: people who are simulated and inferred at once; bounds memory.
        summaries: by name, what is to be known of sites with event dimensions. Sites without are
            always looked at. A summary that returns whole numbers or truth values is discrete.

    Raises:
        ValueError: nobody, no rounds, or rounds that do not increase.
    """

    people: int = 500
    rounds: tuple[int, ...] = (1, 5, 20)
    batch: int = 20
    summaries: Mapping[str, Summary] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("people", "batch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not self.rounds or sorted({0, *self.rounds}) != [0, *self.rounds]:
            raise ValueError(f"rounds must be positive and increase, not {self.rounds}")


@torch.no_grad()
def prior_people(human: HumanModel, people: int, generator: torch.Generator) -> Draws:
    """Values ``[P, 1, ...]`` of all sites, those of ``act`` included, of people from the prior.

    Args:
        human: the model of people.
        people: number of people P.
        generator: source of them.

    Raises:
        ValueError: there are to be no people.
    """
    if people < 1:
        raise ValueError(f"people must be at least 1, not {people}")
    parts = []
    for begin in range(0, people, PEOPLE_AT_ONCE):
        sites = _prior_sites(human, min(PEOPLE_AT_ONCE, people - begin), _seed(generator))
        parts.append({name: site["value"] for name, site in sites.items()})
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def calibrate(
    human: HumanModel,
    infer: Infer,
    options: CalibrationOptions,
    setting: str,
    seed: int,
    report: Report = silent,
) -> Calibration:
    """Hold posteriors against people of whom everything is known, because the model drew them.

    Args:
        human: the model of people, from which people and rounds are drawn.
        infer: what is to be tested.
        options: settings.
        setting: name under which the rounds are recorded.
        seed: of everything random; people and rounds are the same whatever ``infer`` is.
        report: told how many inferences, of one person and number of rounds each, are done.

    Raises:
        UnknownNameError: there is no such setting.
        ValueError: ``infer`` or a summary returned something else than it should.
    """
    require_known(setting, "setting", human.domain.settings)
    generator = torch.Generator(next(human.parameters()).device).manual_seed(seed)
    rng = np.random.default_rng(seed)
    sites = {
        name: site["fn"].support.is_discrete
        for name, site in _prior_sites(human, 1, seed).items()
        if site["fn"].event_dim == 0
    }
    scalars = _Scalars(tuple(sites), options.summaries)
    drawn = prior_people(human, PRIOR_PEOPLE, generator)
    prior = scalars.of(drawn, (PRIOR_PEOPLE,), "the prior")
    discrete = [name for name in sites if sites[name]]
    for name, summary in options.summaries.items():
        discrete += [] if summary(drawn).is_floating_point() else [name]
    parts: dict[int, list[xr.Dataset]] = {number: [] for number in options.rounds}
    total, done = options.people * len(parts), 0
    for begin in range(0, options.people, options.batch):
        people = min(options.batch, options.people - begin)
        implants = prior_people(human, people, generator)
        truth = scalars.of(implants, (people,), "the prior")
        recordings = play_rounds(human, implants, options.rounds[-1], setting, generator)
        for number, judged in parts.items():
            report("calibrate", done, total, f"{number} rounds")
            inferred = infer(recordings.select_rounds(range(number)), _seed(generator))
            number_of_draws = len(next(iter(inferred.draws.values()), ()))
            source = f"infer() of {number} rounds"
            draws = scalars.of(inferred.draws, (number_of_draws, people), source)
            pareto_k = None
            if inferred.pareto_k is not None:
                pareto_k = inferred.pareto_k.detach().double().cpu().numpy()
            judged.append(judge(truth, draws, discrete, rng, pareto_k))
            done += people
    report("calibrate", done, total, "")
    attributes = {
        "domain": human.domain.name,
        "domain_version": human.domain.version,
        "setting": setting,
        "human_model": type(human).__name__,
        "self_model": fingerprint(human.self_model),
        "version": __version__,
        "seed": str(seed),
    }
    return collect(parts, prior, discrete, attributes)


def _seed(generator: torch.Generator) -> int:
    return int(torch.randint(2**31, (), generator=generator, device=generator.device))


def _prior_sites(human: HumanModel, people: int, seed: int) -> dict[str, Any]:
    """Nodes of all sites, sampled for P people."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return sample_sites(human, people)


@dataclass(frozen=True)
class _Scalars:
    """What is one number a person: sites without event dimensions, and summaries."""

    sites: tuple[str, ...]
    summaries: Mapping[str, Summary]

    def __post_init__(self) -> None:
        for name in set(self.sites) & set(self.summaries):
            raise ValueError(f'the summary "{name}" has the name of a site')

    def of(
        self, draws: Mapping[str, Tensor], shape: tuple[int, ...], source: str
    ) -> dict[str, np.ndarray]:
        """Numbers by name, of this shape ``[..., P]``, of draws ``[..., P, 1, ...]``.

        Raises:
            ValueError: something is missing, of another shape or not finite.
        """
        result = {}
        for name in (*self.sites, *self.summaries):
            try:
                value = self.summaries[name](draws) if name in self.summaries else draws[name]
            except KeyError as error:
                raise ValueError(f"{source}: there are no draws of {error}") from error
            if tuple(value.shape) != (*shape, 1):
                raise ValueError(
                    f"{source}: {name} has shape {tuple(value.shape)}, expected {(*shape, 1)}"
                )
            if not value.isfinite().all():
                raise ValueError(f"{source}: {name} has values that are not finite numbers")
            result[name] = value.detach().squeeze(-1).double().cpu().numpy()
        return result

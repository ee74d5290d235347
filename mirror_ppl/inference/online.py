"""One person's posterior, kept up to date while rounds come in."""

from __future__ import annotations

import math
from time import monotonic

import torch

from mirror_ppl.data import Demonstrations
from mirror_ppl.inference.amortized import AmortizedGuide, guide_screening, sample_amortized
from mirror_ppl.inference.importance import ImportanceOptions, sample_exactly
from mirror_ppl.inference.prior import Draws, sample_sites
from mirror_ppl.inference.sampler import Weighted, scalar_sites
from mirror_ppl.inference.second_look import Round, looks_twice, rough, second_look
from mirror_ppl.inference.sightings import Screening, Sightings
from mirror_ppl.inference.views import rounds_of
from mirror_ppl.models.human import HumanModel

ENOUGH = 64.0
"""Effective draws at which a guide proposes no more: enough for an answer that cannot wait."""


class OnlinePosterior:
    """What is known of a person so far; a round more is one term more of their likelihood.

    Args:
        human: the model of people.
        network: a trained guide (see :func:`mirror_ppl.inference.guide_file.load_guide`); without,
            draws are those of ``exact``, which takes longer at each asking.
        seed: of everything random. The same rounds in the same order give the same draws.

    Raises:
        HumanModelError: what people see cannot be marginalized, or reaches their actions otherwise
            than through beliefs.

    Attributes:
        pareto_k: of the importance weights at the last asking; above 0.7 they are not to be relied
            on.
        seconds: that adding took the last time, and asking.
    """

    def __init__(
        self, human: HumanModel, network: AmortizedGuide | None = None, seed: int = 0
    ) -> None:
        self.human = human
        self.network = network
        self.seed = seed
        self._rounds: list[Round] = []
        self.pareto_k = float("nan")
        self.seconds = 0.0, 0.0
        self._screening = Screening() if network is None else guide_screening()
        self._sightings = Sightings(human, self._screening)
        self._sites = scalar_sites(human)
        with torch.random.fork_rng(devices=[]):
            self._order = tuple(sample_sites(human, 1))

    @property
    def rounds(self) -> int:
        """Number of rounds so far."""
        return len(self._rounds)

    def add(self, demonstrations: Demonstrations) -> None:
        """Learn from rounds that have come in.

        Args:
            demonstrations: of one person, of any number of rounds.

        Raises:
            ValueError: they are of more than one person, or of another domain.
        """
        if demonstrations.domain != self.human.domain.name:
            raise ValueError(
                f"the rounds are of {demonstrations.domain}, not of {self.human.domain.name}"
            )
        if demonstrations.num_people != 1:
            raise ValueError(f"the rounds are of {demonstrations.num_people} people, not one")
        began = monotonic()
        if int(demonstrations.round_counts[0]):
            for one_round in rounds_of(demonstrations, 0):
                self._sightings.add(*one_round)
                self._rounds.append(one_round)
        self.seconds = monotonic() - began, self.seconds[1]

    def draws(self, number: int = 200) -> Draws:
        """Posterior draws ``[S, 1, 1, ...]`` of all sites, as ``Person`` takes them.

        Raises:
            ValueError: there was no round yet; see :func:`mirror_ppl.inference.prior.draw_prior`.
        """
        if not self.rounds:
            raise ValueError("there was no round yet; what is known is the prior")
        began = monotonic()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed * 1_000_003 + self.rounds)
            found = self._weighted()
            drawn = found.sample(number, self._sightings.grid)
        self.pareto_k = found.pareto_k
        self.seconds = self.seconds[0], monotonic() - began
        return {name: drawn[name] for name in self._order}

    def _weighted(self) -> Weighted:
        human, options = self.human, ImportanceOptions()
        if self.network is None:
            first = rough(options) if looks_twice(human) else options
            found = sample_exactly(human, self._sightings.table(), first)
        else:
            # What the first asking has checked need not be checked again.
            sites = None if math.isnan(self.pareto_k) else self._sites
            found = sample_amortized(human, self.network, self._sightings, ENOUGH, sites=sites)
        if looks_twice(human):
            _, found = second_look(
                human, self._rounds, self._screening, options, self._sightings, found
            )
        return found

"""Online inference: one person's posterior, updated as rounds arrive."""

from __future__ import annotations

import math
from time import monotonic

from mirror_ppl.checks import real_number, require_kind, seed_number, whole_number
from mirror_ppl.data import Demonstrations
from mirror_ppl.data.contradictions import check_world
from mirror_ppl.errors import InputError
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, coarse, sample_importance
from mirror_ppl.inference.amortized import AmortizedOptions, sample_amortized
from mirror_ppl.inference.amortized_guide import AmortizedGuide, guide_screening, require_network_of
from mirror_ppl.inference.point_proposals import with_points_near
from mirror_ppl.inference.second_look import looks_twice, second_look
from mirror_ppl.inference.weighted import Weighted
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.round_views import Rounds
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.limits import LIMITS
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, sample_sites, scalar_sites
from mirror_ppl.models.recorded import check_rounds
from mirror_ppl.randomness import forked, seed_everything

AT_ONCE = AmortizedOptions(adaptation=ImportanceOptions(128, enough=64.0))
"""Settings with fewer effective draws, for a fast answer."""


class OnlinePosterior:
    """Posterior of one person given the rounds so far; each round adds a likelihood term.

    Args:
        human: the model of people. If it learns about the world, such as which rules hold in bomb
            defusal, call `mirror_ppl.models.world_knowledge.fit_world` first, as every fit does:
            otherwise unobserved parts of the world are inferred from this person alone.
        network: a trained guide (see :func:`mirror_ppl.training.guide_file.load_guide`); without
            it, ``importance`` is used, which takes longer at each call of ``draws``.
        seed: seed of all random draws. The same rounds, added by the same calls, with ``draws``
            called after the same of them, give the same draws. Rounds that are added together are
            processed in an order of their own (:mod:`mirror_ppl.likelihood.telling`), so that draws
            may differ from those of rounds added one by one, but have the same posterior.
        allow_contradictions: share of the steps that are added at once, from 0 to 1, that may
            contradict the next observation.

    Raises:
        InputError: an argument is of another type.
        HumanModelError: the model breaks its contract; perceptual implants affect actions other
            than through beliefs, or a continuous one cannot be inferred.

    Attributes:
        person: id of the person; ``None`` before the first round.
        pareto_k: Pareto k of the importance weights at the last call of ``draws``; above 0.7 they
            are unreliable.
        effective_draws: as how many independent draws they count; at least 64 are asked for with
            a network, otherwise 400.
        seconds: duration of the last calls of ``add`` and of ``draws``.
    """

    def __init__(
        self,
        human: HumanModel,
        network: AmortizedGuide | None = None,
        seed: int = 0,
        allow_contradictions: float = 0.0,
    ) -> None:
        self.human = require_kind(human, HumanModel, "human")
        self.network = None if network is None else require_kind(network, AmortizedGuide, "network")
        if self.network is not None:
            require_network_of(human, self.network)
        check_contract(human)
        self.person: str | None = None
        self.seed = seed_number(seed)
        self.allow_contradictions = real_number(allow_contradictions, "allow_contradictions", 0, 1)
        self._rounds: list[Rounds] = []
        self.pareto_k = self.effective_draws = float("nan")
        self.seconds = 0.0, 0.0
        self._last: Weighted | None = None
        self._near: Weighted | None = None
        self._screening = Screening() if network is None else guide_screening()
        self._builder = ViewTableBuilder(human, self._screening)
        self._sites = scalar_sites(human)
        with forked():
            self._order = tuple(sample_sites(human, 1))

    def __repr__(self) -> str:
        of = "nobody yet" if self.person is None else self.person
        text = f"OnlinePosterior of {of}: {type(self.human).__name__}, rounds {self.rounds}"
        if not math.isnan(self.effective_draws):
            text += f", effective draws {self.effective_draws:.0f}"
        return f"<{text}>"

    @property
    def rounds(self) -> int:
        """Number of rounds so far."""
        return sum(map(len, self._rounds))

    def add(self, demonstrations: Demonstrations) -> None:
        """Add rounds to the likelihood.

        Args:
            demonstrations: any number of rounds of one person.

        Raises:
            InputError: they are no demonstrations, of more than one person, of another person than
                earlier ones, or of another domain.
            DemonstrationsError: they are impossible in the domain's world.
        """
        check_rounds(self.human, demonstrations, people=1)
        check_world(demonstrations, self.allow_contradictions)
        if demonstrations.measurements:
            raise InputError(
                f"{', '.join(demonstrations.measurements)} was measured, which infer() takes into "
                "account and OnlinePosterior does not"
            )
        (person,) = demonstrations.people
        if self.person not in (None, person):
            raise InputError(f"the rounds are of {person!r}, those before of {self.person!r}")
        self.person = person
        began = monotonic()
        self._near = self._last  # fixed until more rounds arrive, so that draws are, too
        if int(demonstrations.round_counts[0]):
            rounds = rounds_of(demonstrations, 0)
            self._builder.add(rounds)
            self._rounds.append(rounds)
        self.seconds = monotonic() - began, self.seconds[1]

    def draws(self, number: int = 200) -> Draws:
        """Posterior draws ``[S, 1, 1, ...]`` of all sites, as ``Person`` takes them.

        Raises:
            InputError: the number is invalid, or there was no round yet; see
                :func:`mirror_ppl.models.prior.draw_prior`.
        """
        number = whole_number(number, "number", *LIMITS["draws"])
        if not self.rounds:
            raise InputError(
                "there was no round yet; what is known is the prior: expected one round or more"
            )
        began = monotonic()
        with forked():
            seed_everything(self.seed * 1_000_003 + self.rounds)
            builder, found = self._weighted()
            drawn = found.sample(number, builder.grid)
        self._last = found
        self.pareto_k, self.effective_draws = found.pareto_k, found.effective
        self.seconds = self.seconds[0], monotonic() - began
        return {name: drawn[name] for name in self._order}

    def _weighted(self) -> tuple[ViewTableBuilder, Weighted]:
        human, builder, options = self.human, self._builder, ImportanceOptions()
        points = builder.grid.is_points
        if self.network is None:
            first = coarse(options) if points or looks_twice(human) else options
            found = sample_importance(human, builder.table(), first, self._near)
        else:
            # Sites are checked at the first call only.
            sites = None if math.isnan(self.pareto_k) else self._sites
            found = sample_amortized(human, self.network, builder, AT_ONCE, sites, self._near)
        if looks_twice(human):
            rounds = Rounds.joined(self._rounds)
            return second_look(human, rounds, self._screening, options, builder, found)
        if points:
            return with_points_near(builder, found, self._rounds, self._screening, options)
        return builder, found
